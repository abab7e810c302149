import json
import sys
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import gripper_force as gf
from gripper_force import cli
from gripper_force.config import config_from_text
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.exports import lerobot as job

FPS = 20
IMAGE = "observation.images.gripper.frame"

needs_lerobot = [
    pytest.mark.lerobot,
    pytest.mark.skipif(find_spec("lerobot") is None, reason="needs lerobot: run make test-lerobot"),
    pytest.mark.filterwarnings("default"),  # LeRobot's own are not ours
]

Rows = list[dict[str, Any]]


def rows_of(path: Path, action: job.Action = "force", fps: int = FPS, with_frames: bool = True) -> Rows:
    reader = gf.LogReader(path)
    shape = (128, 128) if with_frames else None
    return list(job.rows(reader, config_from_text(reader.config, str(path)), fps, action, shape))


@pytest.fixture
def moves_log(quick: list[str], tmp_path: Path) -> Path:
    """Jaws that move to 40 mm and open again."""
    path = tmp_path / "moves.mcap"
    with gf.open_gripper(overrides=[*quick, "object=none"], log=path) as gripper:
        gripper.sleep(0.2)
        gripper.move(0.04)
        gripper.release()
    return path


@pytest.fixture
def stopped_log(quick: list[str], tmp_path: Path) -> Path:
    """A grasp that is stopped while the jaws close, and goes on after a release."""
    path = tmp_path / "stopped.mcap"
    with gf.open_gripper(overrides=quick, log=path) as gripper:
        gripper.grasp(3.0, wait=False)
        gripper.sleep(0.4)
        gripper.stop()
        gripper.sleep(0.2)
        gripper.release()
        gripper.grasp(3.0)
    return path


def test_rows_are_the_newest_values_of_the_log_at_each_time(fused_log: Path) -> None:
    t_ns, values, frames, frame = [], [], [], None
    servo: gf.ServoState | None = None
    force: gf.FusedForce | None = None
    for record in gf.LogReader(fused_log).records():
        match record:
            case gf.Frame():
                frame = record
            case gf.ServoState():
                servo = record
            case gf.FusedForce():
                force = record
            case gf.GraspStatus() if frame is not None:
                assert servo is not None
                assert force is not None
                t_ns.append(record.t_ns)
                values.append((force.force_n, force.std_n, record.width_m, servo.current_a))
                frames.append(frame.gray)
    times_ns = np.arange(t_ns[0], t_ns[-1], 1_000_000_000 // FPS)
    newest = np.searchsorted(t_ns, times_ns, side="right") - 1
    rows = rows_of(fused_log)
    assert len(rows) == len(times_ns)
    assert np.array_equal([row["observation.state"] for row in rows], np.array(values, np.float32)[newest])
    for row, k in zip(rows, newest, strict=True):
        assert np.array_equal(row[IMAGE], np.repeat(frames[k][:, :, None], 3, axis=2))


def test_an_action_is_the_target_that_answers_the_row(fused_log: Path) -> None:
    rows = rows_of(fused_log)
    changes = [(r.t_ns, r.target_n) for r in gf.LogReader(fused_log).records(gf.Request)]
    start_ns = next(gf.LogReader(fused_log).records(gf.Frame)).received_ns
    assert [target_n for _, target_n in changes] == [3.0, 0.0]  # grasp and release
    actions = [float(row["action"][0]) for row in rows]
    grasped, released = actions.index(3.0), len(actions) - actions[::-1].index(3.0)
    assert actions == [0.0] * grasped + [3.0] * (released - grasped) + [0.0] * (len(actions) - released)
    for k, (t_ns, _) in zip((grasped, released), changes, strict=True):
        assert k == pytest.approx((t_ns - start_ns) * FPS / 1e9, abs=1.1)


def test_moves_are_actions_of_the_kind_width(moves_log: Path) -> None:
    rows = rows_of(moves_log, "width", with_frames=False)
    actions = [float(row["action"][0]) for row in rows]
    changes = [after for before, after in pairwise(actions) if after != before]
    assert actions[0] == rows[0]["observation.state"][2]  # no request yet
    assert changes == [np.float32(0.04), np.float32(0.092)]
    with pytest.raises(DataError, match=r"a move to 40\.0 mm, which is no force; use --action width"):
        rows_of(moves_log, "force", with_frames=False)


def test_a_grasp_is_no_width(fused_log: Path) -> None:
    with pytest.raises(DataError, match="a grasp with 3 N, which is no width; use --action force"):
        rows_of(fused_log, "width")


def test_a_grasp_that_was_refused_is_no_action(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "refused.mcap"
    with gf.open_gripper(overrides=quick, log=path) as gripper:
        gripper.grasp(3.0)
        with pytest.raises(gf.RequestError, match="an object is held"):
            gripper.grasp(2.0, new_object=True)
        gripper.sleep(0.2)
        gripper.grasp(2.5)
    assert {float(row["action"][0]) for row in rows_of(path, with_frames=False)} == {0.0, 3.0, 2.5}


def test_an_episode_ends_before_a_stop(stopped_log: Path) -> None:
    records = gf.LogReader(stopped_log).records(gf.Request, gf.GraspStatus)
    stop_ns = next(r.t_ns for r in records if isinstance(r, gf.Request) and r.kind == gf.RequestKind.STOP)
    start_ns = next(gf.LogReader(stopped_log).records(gf.GraspStatus)).t_ns
    rows = rows_of(stopped_log, with_frames=False)
    assert len(rows) == pytest.approx((stop_ns - start_ns) * FPS / 1e9, abs=1)
    assert {float(row["action"][0]) for row in rows} == {0.0, 3.0}


def test_other_images_are_refused(fused_log: Path) -> None:
    reader = gf.LogReader(fused_log)
    with pytest.raises(DataError, match="has images of 128x128 pixels, and the first log of 32x64"):
        list(job.rows(reader, config_from_text(reader.config, ""), FPS, "force", (64, 32)))


def export(*arguments: object) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return CliRunner().invoke(cli.app, ["export", "lerobot", *map(str, arguments)])


def test_without_lerobot_the_extra_is_named(
    fused_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "lerobot"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(ConfigError, match=r"pip install 'gripper-force\[lerobot\]'"):
        job.export_lerobot([fused_log], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_dataset_that_cannot_be_made_leaves_nothing(
    fused_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing:
        @staticmethod
        def create(*, root: Path, **_: object) -> None:
            root.mkdir()
            raise OSError("no space left")

    monkeypatch.setattr(job, "_dataset_class", lambda: Failing)
    with pytest.raises(OSError, match="no space left"):
        job.export_lerobot([fused_log], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_logs_with_and_without_images_are_exported_apart(
    fused_log: Path, moves_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "_dataset_class", lambda: None)
    for logs, which in (([fused_log, moves_log], "has no images"), ([moves_log, fused_log], "has images")):
        with pytest.raises(
            DataError, match=rf"{logs[1].name} {which}, and the first log .*; export them apart"
        ):
            job.export_lerobot(logs, tmp_path / "out")


def test_an_unknown_kind_of_action_is_named(fused_log: Path) -> None:
    done = export(fused_log, "--action", "torque")
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception) == "--action 'torque' is unknown; use force or width"


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))


@pytest.fixture
def read_back(offline: None) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from lerobot.datasets.lerobot_dataset import LeRobotDataset

            return LeRobotDataset("local/dataset", root=folder, video_backend="pyav")

    return read


@pytest.mark.parametrize("video", [True, False])
class TestDataset:
    pytestmark = needs_lerobot

    def test_lerobot_reads_what_was_exported(
        self, fused_log: Path, tmp_path: Path, read_back: Callable[[Path], Any], video: bool
    ) -> None:
        folder = tmp_path / "dataset"
        images = "--video" if video else "--no-video"
        other = tmp_path / "other.mcap"
        other.write_bytes(fused_log.read_bytes())
        done = export(fused_log, other, "--out", folder, "--fps", FPS, images, "--json")
        assert done.exception is None, done.output
        rows = rows_of(fused_log)
        result = json.loads(done.stdout.splitlines()[-1])
        assert result == {"folder": str(folder), "episodes": 2, "frames": 2 * len(rows), "fps": FPS}
        dataset = read_back(folder)
        assert (dataset.num_episodes, dataset.fps) == (2, FPS)
        assert dataset.meta.robot_type == "gripper_force"
        assert dataset.features["observation.state"]["names"] == list(job.STATE)
        for k in (0, len(rows) // 2, len(rows) - 1, 2 * len(rows) - 1):
            item, row = dataset[k], rows[k % len(rows)]
            assert np.array_equal(item["observation.state"], row["observation.state"])
            assert np.array_equal(np.ravel(item["action"]), row["action"])
            assert item["task"] == "grasp the stapler"
            error = 255 * np.asarray(item[IMAGE]).transpose(1, 2, 0) - row[IMAGE]  # (H, W, 3)
            assert np.abs(error).mean() < (4 if video else 1e-3)


class TestFolder:
    pytestmark = needs_lerobot

    def test_a_failed_export_leaves_nothing(
        self, fused_log: Path, moves_log: Path, tmp_path: Path, offline: None
    ) -> None:
        folder = tmp_path / "dataset"
        done = export(fused_log, moves_log, "--out", folder, "--no-video")
        assert isinstance(done.exception, DataError)
        assert not folder.exists()

    def test_logs_without_cycles_are_named(self, few_logs: Path, tmp_path: Path, offline: None) -> None:
        done = export(few_logs, "--out", tmp_path / "dataset")
        assert isinstance(done.exception, DataError)
        assert "control cycles" in str(done.exception)

    def test_an_existing_folder_is_kept(self, fused_log: Path, tmp_path: Path, offline: None) -> None:
        done = export(fused_log, "--out", tmp_path)
        assert isinstance(done.exception, DataError)
        assert tmp_path.exists()
