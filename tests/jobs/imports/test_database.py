import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import config_from_text
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import load_clip
from gripper_force.jobs.imports import database
from gripper_force.jobs.imports.database import (
    find_environments,
    find_sets,
    import_environment,
    read_table,
)
from gripper_force.jobs.paper_protocol import TOUCHES
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, LoadCellSample
from gripper_force.vision.preprocess import Preprocess

PERIOD = 40
"""Frames of one touch and the rest after it."""


def touches(count: int, top_n: float = 6.0) -> npt.NDArray[np.float64]:
    """Returns forces of this many touches, each with half of its rest before and half after it."""
    one = np.interp(np.arange(PERIOD), [0, 11, 17, 22, 28, PERIOD], [0, 0, top_n, top_n, 0, 0])
    return np.tile(one, count)


def write_environment(
    folder: Path, forces_n: Sequence[float] | npt.NDArray[np.float64], first: int = 4
) -> Path:
    """Image ``N`` has the gray level 40 + N at the left and 200 at the right."""
    folder.mkdir(parents=True)
    for number in range(first, first + len(forces_n)):
        image = np.full((16, 16, 3), 200, np.uint8)
        image[:, :8] = 40 + number % 100
        cv2.imwrite(str(folder / f"{number}.jpg"), image)
    write_table(folder, list(enumerate(forces_n, start=first)))
    return folder


def write_table(folder: Path, rows: list[tuple[int, float]]) -> None:
    lines = [f"{number},{force:.8f},{-force:.8f}" for number, force in rows]
    (folder / "test.txt").write_text("\n".join([*lines, ""]))


def rows_of(folder: Path) -> list[str]:
    return (folder / "test.txt").read_text().splitlines()


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """One environment of six touches."""
    return write_environment(tmp_path / "db" / "papercup_10_70", touches(6) - 0.003)


def test_environment_gives_one_log_per_four_touches(environment: Path, tmp_path: Path) -> None:
    row = import_environment(environment, tmp_path / "out")
    assert (row.folder, row.object, row.degrees, row.lux) == ("papercup_10_70", "paper_cup", 10, 550)
    assert (row.logs, row.kept, row.touches, row.frames, row.spikes_rejected) == (2, 0, 6, 240, 0)
    assert row.problems == ()
    first, second = sorted((tmp_path / "out" / "train").iterdir())
    assert (first.name, second.name) == ("papercup_10_70-01.mcap", "papercup_10_70-02.mcap")
    logs = [LogReader(path) for path in (first, second)]
    assert [log.metadata["touches"] for log in logs] == ["4", "2"]
    assert [log.metadata["set"] for log in logs] == [first.stem, second.stem]
    about = {key: logs[0].metadata[key] for key in ("object", "source", "degrees", "illumination", "lux")}
    assert about == {
        "object": "paper_cup",
        "source": "papercup_10_70",
        "degrees": "10",
        "illumination": "70",
        "lux": "550",
    }
    frames = [frame for log in logs for frame in log.records(Frame)]
    assert [frame.seq for frame in frames] == list(range(4, 244))
    assert all(frame.gray.shape == (128, 128) for frame in frames)
    assert [f.gray[64, 20] for f in frames] == pytest.approx([40 + n % 100 for n in range(4, 244)], abs=4)
    samples = [sample for log in logs for sample in log.records(LoadCellSample)]
    assert [s.force_n for s in samples] == pytest.approx(touches(6) - 0.003, abs=1e-7)
    assert samples[-1].t_ns == frames[-1].t_ns == round((frames[-1].seq - 164) * 1e9 / 149)


def test_last_sets_are_for_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "TOUCHES", 1)
    folder = write_environment(tmp_path / "db" / "sponge_0_50", touches(15))
    assert import_environment(folder, tmp_path / "out").logs == 15
    assert len(list((tmp_path / "out" / "train").iterdir())) == 12
    test = sorted(path.stem for path in (tmp_path / "out" / "test").iterdir())
    assert test == ["sponge_0_50-13", "sponge_0_50-14", "sponge_0_50-15"]


def test_clips_of_logs_start_without_contact(environment: Path, tmp_path: Path) -> None:
    import_environment(environment, tmp_path / "out")
    clips = [
        load_clip(path, Preprocess(size=16), None) for path in sorted((tmp_path / "out" / "train").iterdir())
    ]
    assert [(clip.object, clip.set) for clip in clips] == [
        ("paper_cup", "papercup_10_70-01"),
        ("paper_cup", "papercup_10_70-02"),
    ]
    assert all(clip.valid.all() and np.abs(clip.forces_n[:4]).max() < 0.01 for clip in clips)
    assert np.concatenate([clip.forces_n for clip in clips]) == pytest.approx(touches(6) - 0.003, abs=1e-6)


def test_rate_region_and_size(environment: Path, tmp_path: Path) -> None:
    import_environment(environment, tmp_path / "out", rate_hz=30, region=(8, 0, 8, 8), size=32)
    log = LogReader(tmp_path / "out" / "train" / "papercup_10_70-01.mcap")
    assert config_from_text(log.config, "the log").camera.rate_hz == 30
    frames = list(log.records(Frame))
    assert [f.t_ns for f in frames] == [round(i * 1e9 / 30) for i in range(len(frames))]
    assert frames[0].gray.shape == (32, 32)
    assert frames[0].gray.min() > 180
    with pytest.raises(ConfigError, match="region"):
        import_environment(environment, tmp_path / "other", region=(0, 0, 99, 9))
    assert not list((tmp_path / "other").rglob("*.mcap"))


@pytest.mark.parametrize(
    "names", [("sponge_0_50", "sponge"), ("Paper Cup_30_75", "paper_cup"), ("a_b_0_100", "a_b")]
)
def test_object_from_folder_name(names: tuple[str, str], tmp_path: Path) -> None:
    folder = write_environment(tmp_path / "db" / names[0], touches(1))
    assert import_environment(folder, tmp_path / "out").object == names[1]


def test_interrupted_import_continues(environment: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    import_environment(environment, out)
    first, second = sorted((out / "train").iterdir())
    whole = second.read_bytes()
    made_before = first.read_bytes()
    second.unlink()
    (out / f".{second.name}.part").write_bytes(b"half a log")
    row = import_environment(environment, out)
    assert (row.logs, row.kept, row.frames) == (2, 1, 80)
    assert first.read_bytes() == made_before
    assert second.read_bytes() == whole
    assert sorted((out / "train").iterdir()) == [first, second]
    second.unlink()
    with pytest.raises(DataError, match=r"imported with region None, not \[8, 0, 8, 8\]; use another folder"):
        import_environment(environment, out, region=(8, 0, 8, 8))
    with pytest.raises(DataError, match="imported with rate_hz 149, not 30"):
        import_environment(environment, out, rate_hz=30)
    assert not second.exists()


# Sets.


@given(
    counts=st.lists(st.integers(0, 9), min_size=1, max_size=4),
    noise=st.integers(0, 2**32 - 1),
    first=st.integers(0, 1000),
)
def test_sets_hold_four_touches_without_gaps(counts: list[int], noise: int, first: int) -> None:
    rng = np.random.default_rng(noise)
    numbers, forces = [], []
    for count in counts:
        part = touches(count) if count else np.zeros(PERIOD)
        numbers.append(np.arange(len(part)) + first)
        forces.append(part + rng.normal(0, 0.02, len(part)))
        first += len(part) + 100
    number, force_n = np.concatenate(numbers), np.concatenate(forces)
    found = find_sets(number, force_n)
    assert [n for _, n in found] == [
        min(TOUCHES, count - i) for count in counts for i in range(0, max(count, 1), TOUCHES)
    ]
    starts = [start for start, _ in found]
    assert starts[0] == number[0]
    assert starts == sorted(set(starts))
    assert all(abs(force_n[number == start][0]) < 0.25 for start in starts)


def test_bounces_and_single_samples_are_not_touches() -> None:
    force_n = touches(2)
    force_n[17] = 0.0  # within the first
    force_n[38] = 3.0  # in the rest
    assert find_sets(np.arange(80), force_n) == [(0, 2)]


def test_small_gap_stays_within_a_log(environment: Path, tmp_path: Path) -> None:
    for number in range(30, 40):
        (environment / f"{number}.jpg").unlink()
    write_table(environment, [(n, f) for n, f in enumerate(touches(6), start=4) if not 30 <= n < 40])
    row = import_environment(environment, tmp_path / "out")
    assert (row.logs, row.problems) == (2, ())
    frames = list(LogReader(tmp_path / "out" / "train" / "papercup_10_70-01.mcap").records(Frame))
    assert (frames[26].seq, frames[26].t_ns) == (40, round(36 * 1e9 / 149))


# Damage.


def problem_of(environment: Path, tmp_path: Path) -> str:
    (problem,) = import_environment(environment, tmp_path / "out").problems
    return problem


def test_unmatched_images_and_forces_are_reported(environment: Path, tmp_path: Path) -> None:
    for number in (17, 12):
        (environment / f"{number}.jpg").unlink()
    lines = rows_of(environment)
    (environment / "test.txt").write_text("\n".join(lines[:-3]))
    row = import_environment(environment, tmp_path / "out")
    assert row.problems == (
        "2 forces have no image, the first is 12",
        "3 images have no force, the first is 241",
    )
    assert row.frames == 238
    log = LogReader(tmp_path / "out" / "train" / "papercup_10_70-01.mcap")
    assert {12, 17}.isdisjoint(frame.seq for frame in log.records(Frame))


@pytest.mark.parametrize(
    "line",
    [
        "",
        "12;0.1;0.1",
        "12,0.1",
        "12,0.1,0,0",
        "x,0.1,0",
        "-3,0.1,0",
        "7.5,0.1,0",
        "12,nan,0",
        "12,-,0",
        "12,1e9,0",
    ],
)
def test_malformed_lines_are_reported(line: str, environment: Path, tmp_path: Path) -> None:
    lines = rows_of(environment)
    lines[8] = line
    (environment / "test.txt").write_text("\r\n".join(lines))
    row = import_environment(environment, tmp_path / "out")
    bad = f"1 lines are not number,force,unused and were left out, the first is line 9, {line!r}"
    assert row.problems == ((bad,) if line else ()) + ("1 images have no force, the first is 12",)
    assert (row.logs, row.frames) == (2, 240)


def test_unordered_numbers_are_reported_and_sorted(environment: Path, tmp_path: Path) -> None:
    lines = rows_of(environment)
    lines[10], lines[11] = lines[11], lines[10]
    (environment / "test.txt").write_text("\n".join(lines))
    assert problem_of(environment, tmp_path) == (
        "1 lines were out of order and were sorted, the first is line 12, number 14 after 15"
    )
    samples = list(LogReader(tmp_path / "out" / "train" / "papercup_10_70-01.mcap").records(LoadCellSample))
    assert [s.force_n for s in samples] == pytest.approx(touches(6)[: len(samples)] - 0.003, abs=1e-7)


def test_repeated_numbers_are_reported(environment: Path, tmp_path: Path) -> None:
    lines = rows_of(environment)
    (environment / "test.txt").write_text("\n".join([*lines[:30], lines[29], "20,3.5,0", *lines[30:]]))
    row = import_environment(environment, tmp_path / "out")
    assert row.problems == (
        "1 numbers occur twice with the same force and were used once, the first is 33",
        "1 numbers occur with several forces and were left without one, the first is 20",
        "1 images have no force, the first is 20",
    )
    assert row.frames == 240


def test_undecodable_images_are_reported(environment: Path, tmp_path: Path) -> None:
    whole = (environment / "9.jpg").read_bytes()
    (environment / "9.jpg").write_bytes(whole[: len(whole) // 2])
    (environment / "10.jpg").write_bytes(b"")
    (environment / "11.jpg").write_bytes(b"no picture\xff\xd9")
    assert problem_of(environment, tmp_path) == (
        "3 images can't be decoded and were left out, the first is 9.jpg"
    )


def test_set_without_images_gives_no_log(environment: Path, tmp_path: Path) -> None:
    for number in range(164, 244):
        (environment / f"{number}.jpg").write_bytes(b"")
    row = import_environment(environment, tmp_path / "out")
    assert row.problems[-1] == (
        "1 sets have no image with a force and gave no log, the first is papercup_10_70-02"
    )
    assert row.logs == len(list((tmp_path / "out").iterdir())) == 1


def test_unknown_files_and_folders_are_reported(environment: Path, tmp_path: Path) -> None:
    shutil.copy(environment / "9.jpg", environment / "09.jpg")
    (environment / "Thumbs.db").touch()
    (environment.parent / "notes").mkdir()
    (environment.parent / "readme.txt").touch()
    assert find_environments(environment.parent) == ([environment], ["notes", "readme.txt"])
    assert problem_of(environment, tmp_path) == (
        "2 files are neither N.jpg nor test.txt and were left out, the first is 09.jpg"
    )


def test_spikes_are_rejected_and_stay_in_the_log(environment: Path, tmp_path: Path) -> None:
    force_n = touches(6)
    force_n[36] = -9.0
    write_table(environment, list(enumerate(force_n, start=4)))
    row = import_environment(environment, tmp_path / "out")
    samples = list(LogReader(tmp_path / "out" / "train" / "papercup_10_70-01.mcap").records(LoadCellSample))
    assert row.spikes_rejected == 1
    assert [s.raw for s in samples if not s.valid] == [-9.0]


def test_database_is_checked_before_import(environment: Path, tmp_path: Path) -> None:
    database = environment.parent
    with pytest.raises(DataError, match="gone is not a folder"):
        find_environments(tmp_path / "gone")
    with pytest.raises(DataError, match=r"holds no folder named <object>.*; name the folder that holds"):
        find_environments(environment)
    (database / "sponge_0_50").mkdir()
    with pytest.raises(DataError, match=r"1 of 2 folders in .* have no test\.txt: sponge_0_50; download"):
        find_environments(database)
    (database / "sponge_0_50").rename(database / "sponge_0_60")
    (database / "sponge_0_60" / "test.txt").touch()
    with pytest.raises(DataError, match=r"sponge_0_60 is unknown; use one of 50 \(350 lux\), 70 \(550 lux\)"):
        find_environments(database)


def test_environment_without_usable_data_raises(environment: Path, tmp_path: Path) -> None:
    table = environment / "test.txt"
    for text in (b"", b"number,force\n", b"1,0.5,0\n1,0.6,0\n"):
        table.write_bytes(text)
        with pytest.raises(DataError, match=r"test\.txt has no usable line; it needs lines like 4,-0\.0032"):
            import_environment(environment, tmp_path / "out")
    table.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"can't read the table of forces .*test\.txt"):
        read_table(table)
    table.write_text("9000,0.5,0\n")
    with pytest.raises(DataError, match=r"holds no image that its test\.txt names, such as 9000\.jpg"):
        import_environment(environment, tmp_path / "out")


def test_set_that_starts_in_contact_is_marked(tmp_path: Path) -> None:
    forces_n = touches(5)
    forces_n[:3] = 0.4
    folder = write_environment(tmp_path / "db" / "sponge_0_50", forces_n)
    row = import_environment(folder, tmp_path / "out")
    assert row.problems == (
        "1 sets start in contact, and train and evaluate leave them out, the first is sponge_0_50-01",
    )
    logs = [LogReader(path) for path in sorted((tmp_path / "out" / "train").iterdir())]
    assert [log.metadata["starts_in_contact"] for log in logs] == ["true", "false"]
