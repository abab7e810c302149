from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gripper_force.config import Config, dump_config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import (
    CLIP_RECORDS,
    CONTACT_N,
    NEAR_NS,
    Clip,
    StreamedClip,
    digest,
    find_logs,
    indentations,
    label_frames,
    load_clip,
    load_clips,
    split_by,
    starts_in_contact,
    without_contact_starts,
)
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import (
    NS_PER_MS,
    Event,
    Frame,
    LoadCellSample,
    Record,
    Request,
    RequestKind,
    ServoState,
)
from gripper_force.vision.preprocess import Preprocess, downscale

SMALL = Preprocess(size=16)
MS = NS_PER_MS


def sample(t_ms: float, force_n: float, *, valid: bool = True) -> LoadCellSample:
    return LoadCellSample(round(t_ms * MS), force_n, force_n, valid)


def servo(t_ms: float, position_rad: float) -> ServoState:
    return ServoState(round(t_ms * MS), position_rad, 0.0, 0.0, 30.0, 12.0, 0)


def frame(t_ms: float, seq: int) -> Frame:
    gray = np.random.default_rng(seq).integers(0, 256, (30, 40), np.uint8)
    return Frame(round(t_ms * MS), round(t_ms * MS), seq, gray)


def write_log(path: Path, records: Iterable[Record], metadata: dict[str, str], **config: object) -> None:
    with LogWriter(path, config=dump_config(Config.model_validate(config)), metadata=metadata) as log:
        for record in records:
            log.write(record)


def clip(name: str, object_name: str, set_name: str) -> Clip:
    return Clip(
        frames=np.zeros((2, 16, 16), np.uint8),
        forces_n=np.zeros(2, np.float32),
        valid=np.ones(2, np.bool_),
        name=name,
        object=object_name,
        set=set_name,
    )


def test_label_is_mean_over_exposure() -> None:
    samples = [sample(t, 0.1 * t**2) for t in range(0, 100)]
    labels, valid = label_frames(np.array([20 * MS, 50 * MS]), samples, exposure_ns=4 * MS)
    np.testing.assert_allclose(
        labels, [np.mean(0.1 * np.arange(18, 23) ** 2), 0.1 * np.mean(np.arange(48, 53) ** 2)]
    )
    assert valid.all()


def test_label_of_slow_load_cell_is_interpolated() -> None:
    samples = [sample(0, 0.0), sample(40, 4.0), sample(80, 0.0)]
    labels, valid = label_frames(np.array([10, 40, 60]) * MS, samples, exposure_ns=4 * MS)
    np.testing.assert_allclose(labels, [1.0, 4.0, 2.0], rtol=1e-6)
    assert valid.all()


def test_labels_ignore_rejected_samples() -> None:
    samples = [sample(0, 1.0), sample(10, -70.0, valid=False), sample(11, float("nan")), sample(20, 3.0)]
    labels, valid = label_frames(np.array([10 * MS]), samples, exposure_ns=10 * MS)
    np.testing.assert_allclose(labels, [2.0])
    assert valid.all()


def test_frame_far_from_samples_has_no_label() -> None:
    near_ms = NEAR_NS / MS
    t_ms = np.array([0, 100 - near_ms - 1, 100 - near_ms, 100 + near_ms, 100 + near_ms + 1])
    labels, valid = label_frames((t_ms * MS).astype(np.int64), [sample(100, 2.0)], exposure_ns=0)
    assert valid.tolist() == [False, False, True, True, False]
    assert labels.tolist() == [0, 0, 2, 2, 0]
    assert not label_frames(np.array([0]), [sample(0, 1.0, valid=False)], 0)[1].any()


def test_logs_become_clips(tmp_path: Path) -> None:
    frames = [frame(t, seq) for seq, t in enumerate((0, 20, 40, 300))]
    samples = [sample(t, 0.1 * t) for t in range(0, 60, 5)]
    write_log(
        tmp_path / "deep" / "b.mcap",
        [*frames, *samples],
        {"exposure_ms": "10", "set": "press-7"},
        object="stapler",
        vision={"region": [4, 2, 32, 24]},
    )
    write_log(tmp_path / "a.mcap", [frames[0], samples[0]], {}, object="cup")
    a, b = load_clips(tmp_path, SMALL, workers=2)
    assert (a.name, a.object, a.set) == ("a", "cup", "a")
    assert (b.name, b.object, b.set) == ("b", "stapler", "press-7")
    np.testing.assert_array_equal(b.frames, [downscale(f.gray, (4, 2, 32, 24), 16) for f in frames])
    assert b.valid.tolist() == [True, True, True, False]
    np.testing.assert_allclose(b.forces_n[:3], [0.25, 2.0, 4.0], rtol=1e-6)
    (again,) = load_clips([tmp_path / "deep" / "b.mcap"], SMALL, region=(0, 0, 30, 30))
    np.testing.assert_array_equal(again.frames[0], downscale(frames[0].gray, (0, 0, 30, 30), 16))


@pytest.mark.parametrize(
    ("requested_ms", "refused", "begins"),
    [
        ((), False, [0]),
        ((250,), False, [0, 9]),  # frame 12 is exposed at 240 ms; the four before frame 13 are the reference
        ((245, 250), False, [0, 9]),
        ((250, 350), False, [0, 9, 14]),
        ((250,), True, [0]),
        ((50,), False, [0]),  # the first reference is not complete
        ((5000,), False, [0]),
    ],
)
def test_a_log_is_a_clip_for_each_reference(
    tmp_path: Path, requested_ms: tuple[int, ...], refused: bool, begins: list[int]
) -> None:
    forces_n = np.tile([0.0, 0, 0, 0, 0, 1, 2, 3, 0, 0], 3)
    records: list[tuple[float, Record]] = []
    for seq, force_n in enumerate(forces_n):
        records.append((20 * seq, sample(20 * seq, force_n)))
        records.append((20 * seq, frame(20 * seq, seq)))
        records.append((20 * seq, servo(20 * seq, 0.5 if force_n else 0.0)))
    for t_ms in requested_ms:
        records.append((t_ms, Request(t_ms * MS, RequestKind.GRASP, 3.0, new_object=True)))
        if refused:
            records.append((t_ms, Event(t_ms * MS, "control", "refused 'grasp': an object is held")))
    path = tmp_path / "a.mcap"
    write_log(path, [record for _, record in sorted(records, key=lambda pair: pair[0])], {})
    whole = load_clip(path, SMALL, None)
    clips = load_clips(path, SMALL)
    ends = [begin + SMALL.reference_frames for begin in begins[1:]] + [len(forces_n)]
    assert whole.renewals == tuple(ends[:-1])
    assert len(clips) == len(begins)
    for part, begin, end in zip(clips, begins, ends, strict=True):
        np.testing.assert_array_equal(part.frames, whole.frames[begin:end])
        np.testing.assert_array_equal(part.forces_n, forces_n[begin:end])
        assert part.valid.all()
        assert part.renewals == ()
        assert len(part.indentation_m) == end - begin
    streamed = StreamedClip(LogReader(path), Config(), LogReader(path).records(*CLIP_RECORDS), SMALL)
    parts = [(repeated, list(frames)) for repeated, frames in streamed.parts()]
    assert [repeated for repeated, _ in parts] == [0] + [SMALL.reference_frames] * (len(begins) - 1)
    for (_, frames), part in zip(parts, clips, strict=True):
        np.testing.assert_array_equal(frames, part.frames)


def test_a_part_without_labels_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    first = [frame(20 * seq, seq) for seq in range(10)]
    then = [frame(20 * seq, seq) for seq in range(10, 20)]
    request = Request(195 * MS, RequestKind.GRASP, 3.0, new_object=True)
    write_log(path, [sample(0, 0.0), *first, request, *then], {})
    (clip,) = load_clips(path, SMALL)
    assert len(clip.frames) == 10


@pytest.mark.parametrize("logs", [3, [3], None])
def test_logs_that_are_no_paths_are_refused(logs: Any) -> None:
    with pytest.raises(ConfigError, match=r"a log must be a path, not .*; name a file or a folder"):
        find_logs(logs)


def test_missing_logs_frames_or_labels_raise(tmp_path: Path) -> None:
    (tmp_path / "folder.mcap").mkdir()
    with pytest.raises(DataError, match=f"no logs .* in {tmp_path};"):
        load_clips(tmp_path, SMALL)
    write_log(tmp_path / "dark.mcap", [sample(0, 1.0)], {})
    with pytest.raises(DataError, match=r"dark\.mcap holds no camera frames"):
        load_clips(tmp_path, SMALL)
    write_log(tmp_path / "bare.mcap", [frame(0, 0)], {})
    with pytest.raises(DataError, match=r"bare\.mcap holds no valid load-cell sample"):
        load_clips([tmp_path / "bare.mcap"], SMALL)


@pytest.mark.parametrize(
    "metadata",
    [{"exposure_ms": "long"}, {"exposure_ms": "1e999"}, {"scene": "{}"}, {"scene": '{"stiffness": 0}'}],
)
def test_metadata_without_number_raise(tmp_path: Path, metadata: dict[str, str]) -> None:
    write_log(tmp_path / "a.mcap", [frame(0, 0), sample(0, 1.0)], metadata)
    with pytest.raises(DataError, match="hold no number above 0"):
        load_clip(tmp_path / "a.mcap", SMALL, None)


def test_damaged_configuration_raises(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", config="camera: {rate_hz: 2001-99-99}", metadata={}):
        pass
    with pytest.raises(ConfigError, match=r"a\.mcap"):
        load_clip(tmp_path / "a.mcap", SMALL, None)


@pytest.mark.parametrize("key", ["object", "set"])
def test_split_keeps_objects_or_sets_together(key: str) -> None:
    clips = [clip(f"{o}{s}{i}", o, f"{o}{s}") for o in "abc" for s in range(4) for i in range(3)]
    rest, held = split_by(clips, key, 0.25, seed=3)  # type: ignore[arg-type]
    assert sorted(c.name for c in rest + held) == sorted(c.name for c in clips)
    assert not {getattr(c, key) for c in rest} & {getattr(c, key) for c in held}
    assert len({c.object for c in held}) == (1 if key == "object" else 3)
    draws = {tuple(c.name for c in split_by(clips, key, 0.25, seed=s)[1]) for s in range(20)}  # type: ignore[arg-type]
    assert len(draws) > 1


def test_sets_of_several_objects_may_have_one_name() -> None:
    clips = [clip(f"{o}{s}", o, f"{s}") for o in "abcdefgh" for s in range(3)]
    rest, held = split_by(clips, "set", 0.1, seed=1)
    assert (len(rest), len(held)) == (16, 8)
    assert {c.object for c in rest} == {c.object for c in held} == set("abcdefgh")


def test_split_needs_two() -> None:
    with pytest.raises(DataError, match="two"):
        split_by([clip("a", "cup", "s"), clip("b", "cup", "s")], "set", 0.5)


def test_digest_changes_with_every_part() -> None:
    base = clip("a", "cup", "s")
    other_label = clip("a", "cup", "s")
    other_label.forces_n[1] = 1
    assert digest([base]) == digest([clip("b", "cup", "s")])
    assert len({digest([base]), digest([other_label]), digest([base, base])}) == 3


@pytest.mark.parametrize(("frame", "in_contact"), [(0, True), (3, True), (4, False)])
def test_start_in_contact_is_judged_at_the_reference_frames(frame: int, in_contact: bool) -> None:
    forces_n = np.zeros(9, np.float32)
    forces_n[frame] = 1.01 * CONTACT_N
    four = Preprocess(reference_frames=4)
    assert starts_in_contact(forces_n, four) == in_contact
    assert not starts_in_contact(forces_n, Preprocess(reference=False))
    forces_n[frame] = 0.99 * CONTACT_N
    assert not starts_in_contact(forces_n, four)


def test_clips_that_start_in_contact_are_left_out() -> None:
    free, loaded = clip("a", "cup", "s"), clip("b", "cup", "t")
    free.forces_n[:], loaded.forces_n[:] = 0, 1
    assert without_contact_starts([free, loaded], SMALL) == [free]
    without_reference = SMALL.model_copy(update={"reference": False})
    assert without_contact_starts([free, loaded], without_reference) == [free, loaded]
    with pytest.raises(DataError, match="all 1 recordings start in contact"):
        without_contact_starts([loaded], SMALL)


def test_indentation_is_travel_since_first_contact() -> None:
    t_ns = np.arange(6) * 10 * NS_PER_MS
    forces_n = np.array([0, 0, 0.5, 2, 1, 0], np.float32)
    angles = [0.0, 1.0, 2.0, 4.0, 2.5]
    travel_m = indentations(t_ns, forces_n, t_ns[:5], angles, lambda angle: 0.1 - 0.01 * angle)
    assert travel_m[:5] == pytest.approx([0, 0, 0, 0.02, 0.005], abs=1e-7)
    assert np.isnan(travel_m[5])  # no servo state after it
    assert np.isnan(indentations(t_ns, 0 * forces_n, t_ns[:5], angles, lambda angle: angle)).all()
    assert np.isnan(indentations(t_ns, forces_n, t_ns[:0], [], lambda angle: angle)).all()
