from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config
from gripper_force.jobs.dataset import Clip
from gripper_force.qualification.numerics import network_cases as suite
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.qualification.numerics.reference import (
    ENGINE_VARIANTS,
    ROUNDING,
    EngineVariant,
    Float64Result,
    ReferenceEnsemble,
)
from gripper_force.types import Gray
from gripper_force.vision import estimator
from gripper_force.vision.engines import Engine, Floats, StepOutput
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.model_files import read_model

TORCH = ENGINE_VARIANTS[:1]
OPENVINO = EngineVariant("openvino", "float32", ".xml")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compares less of a grasp than the suite does: first contact, and a little more than one window."""
    monkeypatch.setattr(suite, "_COMPARED", 26)


@pytest.fixture(scope="module")
def grasp() -> Clip:
    """Recording of a dark disc that grows with the force, on a noisy background."""
    rng = np.random.default_rng(0)
    forces_n = np.linspace(-2, 6, 80).clip(0).astype(np.float32)
    y, x = np.mgrid[:32, :32]
    edge = 1 + 2 * forces_n[:, None, None] - np.hypot(y - 15.5, x - 15.5)
    frames = np.where(edge > 0, 60, rng.integers(90, 160, (32, 32))) + rng.integers(0, 9, (80, 32, 32))
    valid = np.ones(80, np.bool_)
    return Clip(frames.astype(np.uint8), forces_n, valid, "grasp", "disc", "")


@pytest.fixture
def reference(tiny_checkpoint: Path, tmp_path: Path) -> ReferenceEnsemble:
    return ReferenceEnsemble(read_model(tiny_checkpoint), tmp_path)


def undisturbed(clip: Gray, _seed: int) -> dict[str, Gray]:
    """The first of the cases with frames, which are many."""
    return {"undisturbed grasp": clip}


def broken(rows: list[NumericalCase]) -> list[str]:
    return [row.case for row in rows if not row.ok]


def test_every_case_is_within_its_bound(
    tiny_checkpoint: Path, fused_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Covers the cases that need no export. Those of the head's fit have a test of their own."""
    monkeypatch.setattr(suite, "make_log", lambda *_: fused_log)  # two more grasps take seconds
    monkeypatch.setattr("gripper_force.qualification.numerics.head_fit_cases.cases", lambda: iter(()))
    config = Config.model_validate({"vision": {"checkpoint": str(tiny_checkpoint)}})
    rows = list(suite.cases(config, None, streamed=40, long=40, variants=TORCH))
    assert broken(rows) == []
    assert len({row.case for row in rows}) == len(rows)


def test_a_wrong_engine_is_found(reference: ReferenceEnsemble, grasp: Clip) -> None:
    pytest.importorskip("openvino")
    (row,) = suite._engines(reference, [OPENVINO], grasp, grasp)
    assert row.ok
    assert row.figure > 0
    reference.networks[0].out.weight.mul_(1.0001)
    (row,) = suite._engines(reference, [OPENVINO], grasp, grasp)
    assert not row.ok


def test_wrong_frame_preparation_is_found(
    reference: ReferenceEnsemble, grasp: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "disturbed", undisturbed)
    assert broken(list(suite._frames(reference, grasp, Config()))) == []
    monkeypatch.setattr(suite, "DIFFERENCE_GAIN", 2.01)
    assert "undisturbed grasp" in broken(list(suite._frames(reference, grasp, Config())))


def test_missing_frame_checks_are_found(
    reference: ReferenceEnsemble, grasp: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "disturbed", undisturbed)
    monkeypatch.setattr(FrameChecks, "check", lambda _self, _small: None)
    assert "black, gray or white frames from the start" in broken(
        list(suite._frames(reference, grasp, Config()))
    )


def test_a_claimed_error_that_does_not_grow_is_found(
    grasp: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert suite._range(tmp_path, grasp, Config()).ok
    monkeypatch.setattr(estimator, "RESIDUAL_HALF_N", 1e9)
    assert not suite._range(tmp_path, grasp, Config()).ok


def test_an_engine_that_accepts_nan_is_found(
    grasp: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert broken(list(suite._not_finite(tmp_path, TORCH, grasp))) == []

    def step(self: Engine, frame: Floats) -> StepOutput:
        self._zero_states()
        return self._infer(frame)

    monkeypatch.setattr(Engine, "step", step)
    assert "frames of NaN and infinity" in broken(list(suite._not_finite(tmp_path, TORCH, grasp)))


def test_a_drifting_stream_is_found(
    reference: ReferenceEnsemble, grasp: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool = suite._inputs(reference, grasp)
    drift_n, _, _, last = suite._stream(reference, ENGINE_VARIANTS[0], pool, 30)
    bound_n = reference.bound_n(last, ROUNDING["float32"]).max()
    assert drift_n <= bound_n
    right = Engine.step
    seen: dict[int, int] = {}

    def step(self: Engine, frame: Floats) -> StepOutput:
        seen[id(self)] = seen.get(id(self), 0) + 1
        made = right(self, frame)
        return StepOutput(
            made.forces_n * np.float32(1 + 1e-3 * seen[id(self)]), made.features, made.attention
        )

    monkeypatch.setattr(Engine, "step", step)
    assert suite._stream(reference, ENGINE_VARIANTS[0], pool, 30)[0] > bound_n


def test_a_case_is_that_of_the_worst_member() -> None:
    off_n: Float64Result = np.array([0.1, np.nan, 0.3])
    assert not suite._row("case", "detail", off_n, np.ones(3)).ok
    assert suite._row("case", "detail", off_n[[0, 2]], np.array([0.05, 1.0])).figure == 0.1
