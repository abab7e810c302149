from pathlib import Path

import numpy as np
import pytest

from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs import int8_export
from gripper_force.jobs.int8_export import export_int8, with_added_error
from gripper_force.vision.engines import open_engine
from gripper_force.vision.export import ExportErrors
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import read_model


@pytest.fixture
def model(tiny_checkpoint: Path) -> Model:
    return read_model(tiny_checkpoint)


@pytest.fixture
def recordings() -> list[np.ndarray]:
    """A square that moves over noise."""
    rng = np.random.default_rng(0)
    clips = []
    for _ in range(3):
        clip = rng.integers(90, 110, (160, 32, 32), np.uint8)
        for i, frame in enumerate(clip[10:]):
            frame[8:16, i % 20 : i % 20 + 8] += 60
        clips.append(clip)
    return clips


def test_int8_is_calibrated_on_recordings(
    model: Model, tmp_path: Path, recordings: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("nncf", reason="pip install 'gripper-force[engines]'")
    monkeypatch.setattr(int8_export, "_SAMPLES", 10)  # NNCF corrects each layer with all of them
    errors = export_int8(model, tmp_path / "int8.xml", [clip[:40] for clip in recordings])
    assert 0 < errors["mean_n"] <= errors["rms_n"] <= errors["largest_n"]
    assert b"FakeQuantize" in (tmp_path / "int8.xml").read_bytes()
    opened = open_engine(read_model(tmp_path / "int8.xml"), "openvino", "bfloat16")
    assert np.isfinite(opened.step(np.zeros((32, 32), np.float32)).forces_n).all()
    # The claimed error includes that of the quantisation.
    assert opened.header == with_added_error(model.header, errors)
    for before, after in zip(model.header.residuals, opened.header.residuals, strict=True):
        assert after.std_n**2 == pytest.approx(before.std_n**2 + errors["rms_n"] ** 2)
        assert after.std_n > before.std_n


def test_recordings_without_an_estimate_are_left_out(
    model: Model, tmp_path: Path, recordings: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[np.ndarray] = []

    def split(frames: list[np.ndarray], _: int) -> None:
        seen.extend(frames)
        raise DataError("not exported")

    monkeypatch.setattr(int8_export, "_split", split)
    short = recordings[0][: model.header.preprocess.lead_in]
    with pytest.raises(DataError, match="not exported"):
        export_int8(model, tmp_path / "int8.xml", [*recordings, short])
    assert [len(clip) for clip in seen] == [len(clip) for clip in recordings]
    with pytest.raises(DataError, match="the recordings hold 160; record more"):
        export_int8(model, tmp_path / "int8.xml", [recordings[0], *[short] * 100])


@pytest.mark.parametrize("count", [1, 3])
def test_the_error_is_measured_on_what_the_ranges_have_not_seen(
    model: Model,
    tmp_path: Path,
    recordings: list[np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
    count: int,
) -> None:
    if count == 1:
        recordings = [np.concatenate([*recordings, *recordings])]
    seen: dict[str, list[np.ndarray]] = {}

    def save(network: object, _: Model, path: Path) -> None:
        path.write_text("")

    def quantised(network: object, _: Model, frames: list[np.ndarray]) -> None:
        seen["calibrated"] = frames

    def export_errors(_: Model, path: Path, frames: list[np.ndarray]) -> ExportErrors:
        seen["held out"] = frames
        return ExportErrors(largest_n=0, mean_n=0, rms_n=0)

    for name, stub in (("save_openvino", save), ("_quantised", quantised), ("export_errors", export_errors)):
        monkeypatch.setattr(int8_export, name, stub)
    for name in ("openvino_network", "_replace_header"):
        monkeypatch.setattr(int8_export, name, lambda *_: None)
    export_int8(model, tmp_path / "int8.xml", recordings)
    reference = model.header.preprocess.reference_frames
    (held_out,) = seen["held out"]
    assert sum(map(len, seen["calibrated"])) == sum(map(len, recordings)) - 160 * (3 if count == 1 else 1)
    assert len(held_out) == (480 + reference if count == 1 else 160)
    assert np.array_equal(held_out[-160:], recordings[-1][-160:])


def test_impossible_exports_are_refused(model: Model, tmp_path: Path, recordings: list[np.ndarray]) -> None:
    with pytest.raises(ConfigError, match=r"int8 is exported to OpenVINO only"):
        export_int8(model, tmp_path / "force.onnx", recordings)
    pytest.importorskip("nncf", reason="pip install 'gripper-force[engines]'")
    with pytest.raises(DataError, match="at least 300 frames, and the recordings hold 40"):
        export_int8(model, tmp_path / "force.xml", [recordings[0][:40]])
    assert not list(tmp_path.iterdir())
