from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_calibration.touch_logs import TouchRecording, join, read_log, touch_numbers
from gripper_force.errors import DataError
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_S, Frame, LoadCellSample, Record, Request, RequestKind
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.model_files import read_model
from gripper_force.vision.stream_inference import features


@given(st.lists(st.tuples(st.integers(5, 40), st.integers(3, 40), st.floats(1, 12)), min_size=1, max_size=6))
def test_touch_numbers_divide_at_the_rests(parts: list[tuple[int, int, float]]) -> None:
    rests = [np.concatenate([np.zeros(rest), np.full(press, force_n)]) for rest, press, force_n in parts]
    number = touch_numbers(np.concatenate([*rests, np.zeros(5)]))
    assert (np.diff(number) >= 0).all()
    begins = np.cumsum([0, *(len(rest) for rest in rests[:-1])])
    for i, (begin, (rest, press, _)) in enumerate(zip(begins, parts, strict=True)):
        assert (number[begin + rest : begin + rest + press] == i).all()


def test_short_loss_of_contact_does_not_end_a_touch() -> None:
    force_n = np.concatenate([np.zeros(10), np.full(20, 3.0), np.zeros(2), np.full(20, 3.0), np.zeros(10)])
    assert touch_numbers(force_n).max() == 0
    assert touch_numbers(np.zeros(30)).max() == 0


KNOWN_RIG = "gripper: {nm_per_a: 1.8}"
"""Every log of a run has it; an imported recording has not."""


def recording(path: Path, forces_n: list[float], *, keys: str = "object: mug") -> Path:
    rng = np.random.default_rng(0)
    path.unlink(missing_ok=True)
    with LogWriter(path, config=f"{keys}\ncamera: {{rate_hz: 30.0}}", metadata={}) as log:
        for i, force_n in enumerate(forces_n):
            t_ns = i * NS_PER_S // 30
            log.write(Frame(t_ns, t_ns + 20_000_000, i, rng.integers(0, 256, (48, 64), np.uint8)))
            log.write(LoadCellSample(t_ns, force_n, 0.0, valid=bool(np.isfinite(force_n))))
    return path


def read(path: Path, checkpoint: Path) -> TouchRecording:
    """Reads a log with the networks of a checkpoint."""
    engine = TorchEngine(read_model(checkpoint))
    return read_log(path, engine.header.preprocess, partial(features, engine))


def test_each_reference_of_a_log_is_that_of_the_frames_after_it(
    tmp_path: Path, tiny_checkpoint: Path
) -> None:
    rng = np.random.default_rng(0)
    touch_n = [0.0] * 10 + [2.0] * 20
    records: list[Record] = []
    for i, force_n in enumerate(touch_n * 2):
        t_ns = i * NS_PER_S // 30
        if i == 36:
            records.append(Request(t_ns - 1, RequestKind.GRASP, 2.0, new_object=True))
        records.append(Frame(t_ns, t_ns, i, rng.integers(0, 256, (48, 64), np.uint8)))
        records.append(LoadCellSample(t_ns, force_n, 0.0))

    def written(name: str, records: list[Record]) -> TouchRecording:
        with LogWriter(tmp_path / name, config="object: mug", metadata={}) as log:
            for record in records:
                log.write(record)
        return read(tmp_path / name, tiny_checkpoint)

    begin = records.index(next(r for r in records if isinstance(r, Frame) and r.seq == 32))
    whole, first, second = (
        written(name, part)
        for name, part in (("whole", records), ("first", records[:begin]), ("second", records[begin:]))
    )
    after = len(second.touches.estimate_n) - 1  # the last frame of the reference has an estimate of both
    for key in ("estimate_n", "features"):
        found = getattr(whole.touches, key)
        np.testing.assert_array_equal(found[-after:], getattr(second.touches, key)[-after:])
        of_first = getattr(first.touches, key)
        np.testing.assert_array_equal(found[: len(of_first)], of_first)


def test_join_refuses_logs_of_different_objects_cameras_or_load_cells(
    tmp_path: Path, tiny_checkpoint: Path
) -> None:
    forces_n = [0.0] * 10 + [2.0] * 20
    mug = read(recording(tmp_path / "a.mcap", forces_n, keys=f"object: mug\n{KNOWN_RIG}"), tiny_checkpoint)
    imported = read(recording(tmp_path / "imported.mcap", forces_n), tiny_checkpoint)
    for keys, sentence in (
        ("object: cup", "object cup, and .*a.mcap with mug"),
        ("object: mug\nload_cell: {n_per_raw: 2.0}", r"load_cell\.n_per_raw 2.0"),
        ("object: mug\nload_cell: {backend: phidget}", "load cell phidget"),
        (
            "object: mug\nvision: {region: [0, 0, 48, 48]}",
            r"vision.region \[0, 0, 48, 48\], and .*a.mcap with None",
        ),
    ):
        other = read(recording(tmp_path / "b.mcap", forces_n, keys=f"{keys}\n{KNOWN_RIG}"), tiny_checkpoint)
        with pytest.raises(DataError, match=sentence):
            join(
                {
                    tmp_path / "imported.mcap": imported,
                    tmp_path / "a.mcap": mug,
                    tmp_path / "b.mcap": other,
                }
            )
    retared = recording(tmp_path / "b.mcap", forces_n, keys="object: mug\nload_cell: {tare_raw: 2.0}")
    both = join({tmp_path / "a.mcap": mug, retared: read(retared, tiny_checkpoint)})
    assert both.touches.numbers == [0, 1]
    assert both.camera == mug.camera, "of an imported recording the rig is not known"
    assert imported.camera == {}
    assert mug.camera["vision.region"] is None


def test_log_without_contact_has_no_lag(tmp_path: Path, tiny_checkpoint: Path) -> None:
    recorded = read(recording(tmp_path / "a.mcap", [0.0] * 30), tiny_checkpoint)
    assert not recorded.has_contact
    assert recorded.delay_s == pytest.approx(0.02 + 1 / 60)


def test_log_without_labels_after_the_lead_in_is_refused(tmp_path: Path, tiny_checkpoint: Path) -> None:
    path = recording(tmp_path / "a.mcap", [0.0, 0.0] + [float("nan")] * 30)
    with pytest.raises(
        DataError, match=r".* has no label after its first 3 frames, which the network needs as lead-in"
    ):
        read(path, tiny_checkpoint)


def test_recording_without_a_servo_has_no_presses(tmp_path: Path, tiny_checkpoint: Path) -> None:
    path = recording(tmp_path / "clip.mcap", [max(0.0, 0.2 * (i - 10)) for i in range(40)], keys=KNOWN_RIG)
    recorded = read(path, tiny_checkpoint)
    assert recorded.presses == []
    assert recorded.camera["camera.rate_hz"] == 30
    assert recorded.touches.numbers == [0]
    assert recorded.touches.features.shape == (37, 14)  # 3 lead in; two heads of 7
    assert recorded.delay_s > 0.02 + 1 / 60 - 1e-9
