"""Contract of `gripper_force.vision.engines.Engine`, as a pytest suite."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from gripper_force.errors import NonFiniteError
from gripper_force.vision.engines import Engine, Floats, StepOutput


class EngineContract:
    """Tests that every engine must pass.

    Subclass it and override the fixture `engine`::

        class TestMyEngine(EngineContract):
            @pytest.fixture
            def engine(self) -> Engine:
                return open_engine(read_model("small"), "my_package.engines:MyEngine")
    """

    @pytest.fixture
    def engine(self) -> Engine:
        """The engine under test, without frames so far."""
        raise NotImplementedError("override the fixture `engine`")

    def test_outputs_have_shapes_of_header(self, engine: Engine) -> None:
        """Forces are (M,) and features (F,), both float32; the attention map is (h, w) in 0..1 or None."""
        members = engine.header.members
        step = engine.step(_frames(engine, 1)[0])
        assert step.forces_n.shape == (len(members),)
        assert step.features.shape == (sum(member.head for member in members),)
        assert step.forces_n.dtype == step.features.dtype == np.float32
        assert (step.attention is not None) == any(member.attention == "ssam" for member in members)
        if step.attention is not None:
            assert step.attention.ndim == 2
            assert 0 <= step.attention.min() <= step.attention.max() <= 1

    def test_same_stream_gives_identical_outputs(self, engine: Engine) -> None:
        """A stream after a reset gives the outputs of its first run, bit for bit."""
        frames = _frames(engine, 8)
        first = _forces(engine, frames)
        engine.reset()
        np.testing.assert_array_equal(_forces(engine, frames), first)

    def test_reset_forgets_the_stream(self, engine: Engine) -> None:
        """A reset removes every effect of the frames before it."""
        frames = _frames(engine, 4)
        expected = _forces(engine, frames)
        _forces(engine, _frames(engine, 9, seed=1))
        engine.reset()
        np.testing.assert_array_equal(_forces(engine, frames), expected)

    def test_frames_before_the_first_are_copies_of_it(self, engine: Engine) -> None:
        """The first frame given again gives the same forces."""
        frame = _frames(engine, 1)[0]
        forces_n = _forces(engine, [frame] * 3)
        np.testing.assert_allclose(
            forces_n, np.broadcast_to(forces_n[0], forces_n.shape), rtol=1e-5, atol=1e-5
        )

    def test_outputs_are_not_overwritten(self, engine: Engine) -> None:
        """A step leaves the arrays of the step before it as they were."""
        first, second = _frames(engine, 2)
        step = engine.step(first)
        copies = [np.copy(array) for array in _arrays(step)]
        engine.step(second)
        for array, copy in zip(_arrays(step), copies, strict=True):
            np.testing.assert_array_equal(array, copy)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_non_finite_frame_is_refused_and_skipped(self, engine: Engine, value: float) -> None:
        """A frame with NaN or infinity raises `NonFiniteError` and has no effect on the stream."""
        frames = _frames(engine, 3)
        spoiled = frames[1].copy()
        spoiled[3, 4] = value
        expected = _forces(engine, frames)
        engine.reset()
        forces = []
        for frame in frames:
            with pytest.raises(NonFiniteError):
                engine.step(spoiled)
            forces.append(engine.step(frame).forces_n)
        np.testing.assert_array_equal(forces, expected)


def _frames(engine: Engine, count: int, seed: int = 0) -> npt.NDArray[np.float32]:
    """Returns prepared frames of noise, (count, S, S)."""
    size = engine.header.preprocess.size
    return np.random.default_rng(seed).normal(size=(count, size, size)).astype(np.float32)


def _forces(engine: Engine, frames: Sequence[Floats] | Floats) -> Floats:
    """Returns each member's forces for the frames, (T, M)."""
    return np.stack([engine.step(frame).forces_n for frame in frames])


def _arrays(step: StepOutput) -> list[Floats]:
    return [step.forces_n, step.features, *([] if step.attention is None else [step.attention])]
