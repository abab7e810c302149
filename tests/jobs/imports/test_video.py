import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import yaml
from typer.testing import CliRunner

from gripper_force.cli import app
from gripper_force.config import config_from
from gripper_force.errors import ConfigError, DataError, LogError
from gripper_force.jobs.imports.video import (
    import_folder,
    import_video,
    object_of,
)
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import Frame, LoadCellSample, Record

RATE_HZ = 30.0


def grip(count: int = 60, top_n: float = 20.0) -> npt.NDArray[np.float64]:
    """Nothing, a ramp, a hold, a fast release, nothing."""
    return np.interp(np.arange(count), [0, 15, 30, 45, 50, count], [0, 0, top_n, top_n, 0, 0])


def write_video(path: Path, count: int = 60) -> Path:
    """Frame ``i`` has gray level 2 i + 40 at the left half and 200 at the right."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (64, 48))
    for i in range(count):
        image = np.full((48, 64, 3), 200, np.uint8)
        image[:, :32] = 2 * i + 40
        video.write(image)
    video.release()
    return path


def write_table(path: Path, forces_n: npt.ArrayLike, frames: list[int] | None = None) -> Path:
    values = np.asarray(forces_n)
    rows = [
        f"{i},{i / RATE_HZ:.6f},{force:.5f},"
        for i, force in zip(frames or range(len(values)), values, strict=True)
    ]
    path.write_text("\n".join(["frame,t_s,force_n,width_m", *rows, ""]))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One recording."""
    folder = tmp_path / "2024-01-31_foam_brick_2"
    folder.mkdir()
    write_video(folder / "video.avi")
    write_table(folder / "load_cell.csv", grip() + 0.5)
    return folder


def test_log_holds_frames_and_samples_in_order_of_time(folder: Path, tmp_path: Path) -> None:
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert (summary.frames, summary.samples, summary.object) == (60, 60, "foam_brick")
    assert summary.tare_n == pytest.approx(0.5, abs=1e-4)
    log = LogReader(summary.log)
    assert log.metadata["object"] == "foam_brick"
    assert log.metadata["set"] == "2024-01-31_foam_brick"
    assert log.metadata["source"] == "2024-01-31_foam_brick_2"
    assert float(log.metadata["tare_n"]) == pytest.approx(0.5, abs=1e-4)
    assert log.attachments["load_cell.csv"] == (folder / "load_cell.csv").read_bytes()
    records = list(log.records())
    assert [record.t_ns for record in records] == sorted(record.t_ns for record in records)
    frames = list(log.records(Frame))
    assert [frame.seq for frame in frames] == list(range(60))
    assert all(frame.gray.shape == (128, 128) for frame in frames)
    assert [frame.gray[64, 20] for frame in frames] == pytest.approx([2 * i + 40 for i in range(60)], abs=3)
    samples = list(log.records(LoadCellSample))
    assert [s.t_ns for s in samples] == [f.t_ns for f in frames]
    assert [s.force_n for s in samples] == pytest.approx(grip(), abs=1e-4)
    assert [s.raw for s in samples] == pytest.approx(grip() + 0.5, abs=1e-4)
    assert all(s.valid for s in samples)


@pytest.mark.parametrize("first_n", [0.0, 0.5])
def test_recording_that_starts_in_contact_is_marked(first_n: float, folder: Path, tmp_path: Path) -> None:
    forces_n = grip()
    forces_n[0] += first_n
    write_table(folder / "load_cell.csv", forces_n)
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert summary.starts_in_contact == (first_n > 0)
    assert LogReader(summary.log).metadata["starts_in_contact"] == ("true" if first_n else "false")


def test_real_recordings_that_start_in_contact_are_found(real_grasps: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for recording in real_grasps.glob("*_foam_brick_[123]"):
        (source / recording.name).symlink_to(recording)
    loaded = [s.log.stem for s in import_folder(source, tmp_path / "out") if s.starts_in_contact]
    days = ("2023-11-18", "2023-12-06")
    assert loaded == [f"{day}_foam_brick_{trial}" for day in days for trial in (1, 2, 3)]


def test_configuration_of_log_names_the_object(folder: Path, tmp_path: Path) -> None:
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert config_from(yaml.safe_load(LogReader(summary.log).config), "the log").object == "foam_brick"


def test_region_is_cropped_and_resized(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "x.mcap"
    import_video(folder / "video.avi", folder / "load_cell.csv", log, region=(40, 8, 20, 20), size=32)
    frame = next(LogReader(log).records(Frame))
    assert frame.gray.shape == (32, 32)
    assert frame.gray.min() > 190
    with pytest.raises(ConfigError, match="region"):
        import_video(
            folder / "video.avi", folder / "load_cell.csv", tmp_path / "y.mcap", region=(60, 0, 9, 9)
        )
    assert not (tmp_path / "y.mcap").exists()


def test_pairs_of_files_and_object_name(folder: Path, tmp_path: Path) -> None:
    pairs = tmp_path / "pairs"
    pairs.mkdir()
    shutil.copy(folder / "video.avi", pairs / "egg_1.avi")
    shutil.copy(folder / "load_cell.csv", pairs / "egg_1.csv")
    (summary,) = import_folder(pairs, tmp_path / "out")
    assert (summary.log.name, summary.object) == ("egg_1.mcap", "egg")
    named = import_video(
        pairs / "egg_1.avi", pairs / "egg_1.csv", tmp_path / "named.mcap", object_name="goose_egg"
    )
    assert named.object == LogReader(named.log).metadata["object"] == "goose_egg"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("2023-12-16_blue_foam_brick_harder_0", "blue_foam_brick_harder"),
        ("foam_brick_12", "foam_brick"),
        ("sponge", "sponge"),
        ("2023-12-16_egg", "egg"),
        ("20231216_egg_2", "egg"),
        ("7", "7"),
    ],
)
def test_object_from_name(name: str, expected: str) -> None:
    assert object_of(name) == expected


def test_unmatched_frames_and_rows_are_counted(folder: Path, tmp_path: Path) -> None:
    table = folder / "load_cell.csv"
    rows = [i for i in range(70) if i not in (7, 8)]
    write_table(table, np.interp(rows, range(60), grip()), rows)
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert (summary.frames, summary.samples) == (60, 68)
    assert (summary.frames_without_force, summary.forces_without_frame) == (2, 10)
    write_table(table, grip()[5:50], list(range(5, 50)))
    (summary,) = import_folder(tmp_path, tmp_path / "out2")
    assert (summary.frames_without_force, summary.forces_without_frame) == (15, 0)
    t_ns = [frame.t_ns for frame in LogReader(summary.log).records(Frame)]
    assert np.diff(t_ns) == pytest.approx(np.full(59, 1e9 / RATE_HZ), rel=1e-3)


def test_missing_files_raise(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"can't read the table .*gone\.csv: No such file"):
        import_video(folder / "video.avi", tmp_path / "gone.csv", tmp_path / "x.mcap")
    with pytest.raises(DataError, match=r"no video .*gone\.avi"):
        import_video(tmp_path / "gone.avi", folder / "load_cell.csv", tmp_path / "x.mcap")
    with pytest.raises(DataError, match="is not a folder"):
        import_folder(tmp_path / "gone", tmp_path / "out")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(DataError, match="holds no recordings"):
        import_folder(empty, tmp_path / "out")
    shutil.copy(folder / "video.avi", empty / "lonely.avi")
    with pytest.raises(DataError, match=r"lonely\.avi has no table of forces; put lonely\.csv next"):
        import_folder(empty, tmp_path / "out")
    (folder / "load_cell.csv").unlink()
    with pytest.raises(DataError, match=r"foam_brick_2 holds 1 videos and 0 \.csv tables"):
        import_folder(tmp_path, tmp_path / "out")


def test_undecodable_video_raises(folder: Path, tmp_path: Path) -> None:
    (folder / "video.avi").write_bytes(b"no video" * 100)
    with pytest.raises(DataError, match=r"video\.avi has no frame that can be decoded"):
        import_folder(tmp_path, tmp_path / "out")


def test_existing_log_is_not_overwritten(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "x.mcap"
    import_video(folder / "video.avi", folder / "load_cell.csv", log)
    with pytest.raises(LogError, match="it exists already"):
        import_video(folder / "video.avi", folder / "load_cell.csv", log)


def test_a_folder_that_has_grown_is_continued(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (first,) = import_folder(tmp_path, tmp_path / "logs")
    before = first.log.read_bytes()
    shutil.copytree(folder, tmp_path / "2024-01-31_foam_brick_3")
    done = CliRunner().invoke(app, ["import", "video", str(tmp_path), "--out", "logs", "--json"])
    assert done.exit_code == 0, done.stderr
    (second,) = json.loads(done.stdout)["logs"]
    assert Path(second["log"]).name == "2024-01-31_foam_brick_3.mcap"
    assert "1 of 2 logs existed already and were kept" in done.stderr
    assert first.log.read_bytes() == before


def test_table_may_start_after_video(folder: Path, tmp_path: Path) -> None:
    table = folder / "load_cell.csv"
    rows = [f"{i},{(i - 3) / RATE_HZ:.6f},{force:.5f}" for i, force in enumerate(grip()) if i >= 3]
    table.write_text("\n".join(["frame,t_s,force_n", *rows, ""]))
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert (summary.frames, summary.samples, summary.frames_without_force) == (60, 57, 3)
    log = LogReader(summary.log)
    frames, samples = list(log.records(Frame)), list(log.records(LoadCellSample))
    assert frames[0].t_ns == 0
    assert samples[0].t_ns == frames[3].t_ns == pytest.approx(3e9 / RATE_HZ, abs=1e3)


def test_interrupted_import_leaves_no_log(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, count = LogWriter.write, 0

    def write_some(log: LogWriter, record: Record) -> None:
        nonlocal count
        count += 1
        if count == 50:
            raise KeyboardInterrupt
        write(log, record)

    with monkeypatch.context() as patch:
        patch.setattr(LogWriter, "write", write_some)
        with pytest.raises(KeyboardInterrupt):
            import_folder(tmp_path, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.mcap"))
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    assert len(list(LogReader(summary.log).records())) == 120
    assert [path.name for path in (tmp_path / "out").iterdir()] == [summary.log.name]


def test_spikes_are_rejected_and_stay_in_the_log(folder: Path, tmp_path: Path) -> None:
    force_n = grip()
    force_n[[5, 38]] += [4.0, -9.0]
    force_n[52:58] = [-0.2, -3.0, -40.0, -70.0, -5.0, -0.15]
    write_table(folder / "load_cell.csv", force_n)
    (summary,) = import_folder(tmp_path, tmp_path / "out")
    samples = list(LogReader(summary.log).records(LoadCellSample))
    assert [i for i, s in enumerate(samples) if not s.valid] == [5, 38, 52, 53, 54, 55, 56, 57]
    assert summary.spikes_rejected == 8
    assert samples[55].raw == -70.0


def test_lag_of_forces_is_removed_unless_disabled(folder: Path, tmp_path: Path) -> None:
    squeezed = cv2.VideoWriter(str(folder / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (64, 48))
    for force in grip(90):
        image = np.full((48, 64, 3), 200, np.uint8)
        image[:, : 10 + round(force)] = 60
        squeezed.write(image)
    squeezed.release()
    for frames, name in [(3, "late"), (-3, "early")]:
        write_table(folder / "load_cell.csv", np.roll(grip(90), frames))
        (summary,) = import_folder(tmp_path, tmp_path / name)
        assert summary.force_lag_s == pytest.approx(frames / RATE_HZ, abs=0.01)
        log = LogReader(summary.log)
        assert float(log.metadata["force_lag_s"]) == pytest.approx(summary.force_lag_s, abs=1e-4)
        frame, sample = next(log.records(Frame)), next(log.records(LoadCellSample))
        assert frame.t_ns - sample.t_ns == pytest.approx(summary.force_lag_s * 1e9, abs=1)
        assert min(frame.t_ns, sample.t_ns) == 0
        (as_it_is,) = import_folder(tmp_path, tmp_path / f"{name}_as_it_is", align=False)
        assert as_it_is.force_lag_s == 0.0


def test_known_problems_of_real_recordings_are_found(real_grasps: Path, tmp_path: Path) -> None:
    """Uses the recordings with known problems; all 48 take ten seconds."""
    names = [
        "2023-12-16_blue_foam_brick_harder_0",
        "2023-12-06_foam_brick_1",
        "2023-11-11_small_rigid_sphere_1",
        "2023-11-18_rigid_strawberry_3",
    ]
    source = tmp_path / "source"
    source.mkdir()
    for name in names:
        (source / name).symlink_to(real_grasps / name)
    by_name = {summary.log.stem: summary for summary in import_folder(source, tmp_path / "out")}
    blue, near_contact, sphere, strawberry = (by_name[name] for name in names)
    assert (sphere.spikes_rejected, sphere.tare_note) == (0, "")
    assert abs(sphere.tare_n) < 0.02
    assert near_contact.tare_n == 0.0
    assert "contact may be near" in near_contact.tare_note
    assert blue.tare_n == pytest.approx(0.55, abs=0.02)
    assert (sphere.force_lag_s, near_contact.force_lag_s) == (0.0, 0.0)
    assert strawberry.force_lag_s == pytest.approx(0.09, abs=0.015)  # its force rises three frames late
    samples = list(LogReader(blue.log).records(LoadCellSample))
    assert not any(s.valid for s in samples if s.raw < -1.0)
    assert all(s.valid for s in samples if s.force_n > 1.0)
