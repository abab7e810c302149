"""The robot against the interface of LeRobot, on the simulated gripper."""

import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import gripper_force as gf
from gripper_hw.dynamixel.pty_server import PtyServer, serve_virtual_servo
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus

Make = Callable[..., Any]

FORCE, WIDTH = "gripper.force_n", "gripper.width_m"


def register(name: str, served: PtyServer | None = None) -> int:
    """Reads a register of the virtual servo."""
    bus: VirtualBus | None = find_bus("rig") if served is None else served.bus
    assert bus is not None
    return bus.servos[0].get(name)


def run(robot: Any, frames: int, **action: float) -> dict[str, Any]:
    """Observes and acts for a number of frames. Returns the last observation."""
    observation: dict[str, Any] = {}
    for _ in range(frames):
        observation = robot.get_observation()
        robot.send_action({f"gripper.{key}": value for key, value in action.items()})
    return observation


def test_lerobot_finds_the_robot_by_its_type(robots: ModuleType, tmp_path: Path) -> None:
    from lerobot.robots import RobotConfig, make_robot_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    config_class = RobotConfig.get_choice_class("gripper_force")
    robot = make_robot_from_config(config_class(calibration_dir=tmp_path))
    assert type(robot) is robots.GripperForce
    assert robot.config.type == "gripper_force"


def test_features_are_known_without_a_connection_and_match_the_values(make_robot: Make) -> None:
    robot = make_robot()
    assert not robot.is_connected
    assert robot.is_calibrated
    features = robot.observation_features
    assert features == {
        **dict.fromkeys((FORCE, "gripper.std_n", WIDTH, "gripper.current_a"), float),
        "gripper.frame": (128, 128, 3),
    }
    assert robot.action_features == {FORCE: float}
    robot.connect()
    observation = robot.get_observation()
    assert list(observation) == list(features)
    image = observation.pop("gripper.frame")
    assert (image.shape, image.dtype) == ((128, 128, 3), np.uint8)
    assert np.array_equal(image[..., 0], robot.gripper.frame.gray)
    assert (image == image[..., :1]).all()
    assert all(isinstance(value, float) for value in observation.values())


def test_without_a_camera_there_is_no_frame(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none", action="width")
    assert "gripper.frame" not in robot.observation_features
    assert robot.action_features == {WIDTH: float}
    robot.connect()
    assert list(robot.get_observation()) == list(robot.observation_features)


def test_a_force_is_held_and_zero_opens_the_jaws(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none")
    robot.connect()
    held = run(robot, 80, force_n=3.0)
    assert held[FORCE] == pytest.approx(3.0, rel=0.15)
    assert robot.gripper.state.phase == gf.Phase.HOLD
    assert run(robot, 30, force_n=0.0)[WIDTH] > 0.085


def test_actions_are_limited_and_the_sent_one_is_returned(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none")
    robot.connect()
    largest_n = robot.gripper.largest_force_n
    assert 5 < largest_n < robot.settings.control.force_limit_n
    sent = [robot.send_action({FORCE: force_n})[FORCE] for force_n in (1e6, 3.0, 0.1, -2.0)]
    assert sent == [largest_n, 3.0, 0.0, 0.0]
    assert robot.send_action({FORCE: np.float32(2.5)}) == {FORCE: 2.5}


def test_widths_are_limited_and_reached(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none", "object=none", action="width")
    robot.connect()
    assert robot.send_action({WIDTH: 1.0}) == {WIDTH: robot.settings.gripper.open_width_m}
    assert robot.send_action({WIDTH: -1.0}) == {WIDTH: 0.0}
    assert run(robot, 60, width_m=0.05)[WIDTH] == pytest.approx(0.05, abs=0.002)


@pytest.mark.parametrize("kind", ["force", "width"])
def test_no_number_is_refused_and_nothing_moves(make_robot: Make, kind: str) -> None:
    robot = make_robot("camera.backend=none", action=kind)
    robot.connect()
    (key,) = robot.action_features
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(gf.RequestError, match="is not finite"):
            robot.send_action({key: value})
    width_m = robot.get_observation()[WIDTH]
    assert robot.get_observation()[WIDTH] == width_m
    assert robot.gripper.state.phase == gf.Phase.OPEN


def test_an_action_of_the_other_kind_is_named(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none")
    robot.connect()
    with pytest.raises(
        gf.RequestError, match=r"has no gripper\.force_n, but gripper\.width_m; set --robot\.action"
    ):
        robot.send_action({WIDTH: 0.05})


def test_an_equal_action_makes_no_new_request(make_robot: Make, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    robot = make_robot("camera.backend=none", log=log)
    robot.connect()
    run(robot, 20, force_n=3.0)
    run(robot, 5, force_n=2.0)
    run(robot, 5, force_n=0.0)
    robot.disconnect()
    requests = [(record.kind, record.target_n) for record in gf.LogReader(log).records(gf.Request)]
    assert requests == [("grasp", 3.0), ("grasp", 2.0), ("move", 0.0)]


def test_a_grasp_from_open_jaws_is_of_a_new_object(make_robot: Make, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    robot = make_robot("camera.backend=none", log=log)
    robot.connect()
    for force_n, count in ((3.0, 20), (2.0, 5), (0.0, 60), (3.0, 20), (0.0, 2), (3.0, 2)):
        run(robot, count, force_n=force_n)
    robot.disconnect()
    requests = [(r.kind, r.new_object) for r in gf.LogReader(log).records(gf.Request)]
    held, opened = ("grasp", False), ("move", False)
    assert requests == [("grasp", True), held, opened, ("grasp", True), opened, held]


@pytest.mark.parametrize("action", [3.0, 2.0, 0.0])
def test_no_action_resets_a_stop(make_robot: Make, action: float) -> None:
    robot = make_robot("camera.backend=none")
    robot.connect()
    run(robot, 60, force_n=3.0)
    robot.gripper.stop()
    with pytest.raises(gf.RequestError):  # both before the cycle that stops, and after it
        run(robot, 3, force_n=action)
    robot.get_observation()
    with pytest.raises(gf.RequestError, match="stopped or is at fault"):
        robot.send_action({FORCE: action})
    assert robot.gripper.state.phase == gf.Phase.FAULT
    assert register("goal_current") == 0
    robot.gripper.release()
    run(robot, 2, force_n=1.0 + action)
    assert robot.gripper.state.phase != gf.Phase.FAULT


def test_an_action_from_before_a_stop_is_sent_again_after_the_release(make_robot: Make) -> None:
    robot = make_robot("camera.backend=none")
    robot.connect()
    run(robot, 60, force_n=3.0)
    robot.gripper.stop()
    robot.get_observation()
    with pytest.raises(gf.RequestError, match="stopped or is at fault"):
        robot.send_action({FORCE: 3.0})
    robot.gripper.release()
    run(robot, 90, force_n=3.0)
    assert robot.gripper.state.phase == gf.Phase.HOLD


@pytest.mark.parametrize("on_exit", ["release", "hold"])
def test_disconnect_turns_torque_off_whatever_is_configured(make_robot: Make, on_exit: str) -> None:
    robot = make_robot("camera.backend=none", f"on_exit={on_exit}")
    robot.connect()
    run(robot, 60, force_n=3.0)
    bus = find_bus("rig")
    assert bus is not None
    assert bus.servos[0].get("torque_enable") == 1
    robot.disconnect()
    assert bus.servos[0].get("torque_enable") == 0
    assert not robot.is_connected


def test_states_of_the_connection_are_checked(make_robot: Make) -> None:
    from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

    robot = make_robot("camera.backend=none")
    for call in (robot.get_observation, robot.disconnect, lambda: robot.send_action({FORCE: 1.0})):
        with pytest.raises(DeviceNotConnectedError):
            call()
    robot.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    robot.disconnect()
    robot.connect()  # again
    assert run(robot, 2, force_n=2.0)[FORCE] < 2.0


def test_wrong_configurations_are_named(make_robot: Make, robots: ModuleType) -> None:
    with pytest.raises(gf.ConfigError, match="nowhere"):
        make_robot("control.nowhere=1")
    for keys in ({"action": "torque"}, {"open_below_n": 0.0}, {"lockstep_fps": 0}):
        with pytest.raises(ValueError, match=next(iter(keys))):
            robots.GripperForceConfig(**keys)
    with pytest.raises(ValueError, match="targets"):
        robots.TargetStepsConfig(targets=[])


def test_targets_follow_each_other(robots: ModuleType, tmp_path: Path) -> None:
    config = robots.TargetStepsConfig(targets=[3.0, 0.0], frames=2, calibration_dir=tmp_path)
    teleoperator = robots.TargetSteps(config)
    teleoperator.connect()
    assert [teleoperator.get_action()[FORCE] for _ in range(5)] == [3.0, 3.0, 0.0, 0.0, 3.0]
    teleoperator.disconnect()
    assert not teleoperator.is_connected


# In real time, where a thread of the gripper runs the cycle.


@pytest.fixture
def server() -> Iterator[PtyServer]:
    with serve_virtual_servo("XM430-W350") as served:
        yield served


@pytest.fixture
def real_robot(make_robot: Make, server: PtyServer) -> Any:
    return make_robot(
        "clock=realtime",
        f"servo.port={server.device_path}",
        "camera.backend=none",
        "load_cell.backend=none",
        "servo.bus_watchdog_ms=2540",  # the machine that tests may be busy
        "servo.reply_margin_ms=500",
    )


def test_a_stop_from_another_thread_wins_over_a_stream_of_actions(real_robot: Any, server: PtyServer) -> None:
    real_robot.connect()
    gripper = real_robot.gripper
    assert register("torque_enable", server) == 1
    started, errors = threading.Event(), []

    def stream() -> None:
        try:
            for i in range(10_000_000):
                real_robot.send_action({FORCE: 1.0 + i % 3 if i % 5 else 0.0})
                started.set()
        except gf.RequestError as error:
            errors.append(error)

    thread = threading.Thread(target=stream)
    thread.start()
    assert started.wait(60)
    gripper.stop()
    thread.join(60)
    assert not thread.is_alive()
    assert len(errors) == 1
    gripper.sleep(0.3)
    assert gripper.state.phase == gf.Phase.FAULT
    assert register("goal_current", server) == 0
    real_robot.disconnect()
    assert register("torque_enable", server) == 0


def test_a_lost_servo_ends_the_observations(real_robot: Any, server: PtyServer) -> None:
    real_robot.connect()
    assert real_robot.get_observation()[WIDTH] > 0
    server.close()
    with pytest.raises(gf.DeviceError):
        for _ in range(1000):
            real_robot.get_observation()
            real_robot.gripper.sleep(0.01)
    real_robot.disconnect()
    assert not real_robot.is_connected


# Further cameras.


class StillCamera:
    """A camera of LeRobot that gives one black image."""

    is_connected = False

    def __init__(self, config: Any) -> None:
        self.width, self.height = config.width, config.height

    def connect(self) -> None:
        self.is_connected = True

    def async_read(self) -> Any:
        if not self.is_connected:
            raise RuntimeError("the camera is not connected")
        return np.zeros((self.height, self.width, 3), np.uint8)

    def disconnect(self) -> None:
        self.is_connected = False


@pytest.fixture
def still_cameras(robots: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot makes a `StillCamera` of every configuration of a camera."""

    def make(configs: dict[str, Any]) -> dict[str, StillCamera]:
        return {name: StillCamera(config) for name, config in configs.items()}

    monkeypatch.setattr(robots.gripper_force, "make_cameras_from_configs", make)


def test_further_cameras_are_observed(make_robot: Make, cameras: ModuleType, still_cameras: None) -> None:
    wrist = cameras.OakCameraConfig(width=30, height=30)
    robot = make_robot("camera.backend=none", cameras={"wrist": wrist})
    assert robot.observation_features["wrist"] == (30, 30, 3)
    robot.connect()
    assert robot.get_observation()["wrist"].shape == (30, 30, 3)
    robot.disconnect()
    assert not robot.cameras["wrist"].is_connected


def test_cameras_are_closed_if_the_gripper_cannot_be_opened(
    make_robot: Make, cameras: ModuleType, still_cameras: None
) -> None:
    missing = ("clock=realtime", "servo.port=/dev/nowhere", "load_cell.backend=none")
    robot = make_robot(*missing, "camera.backend=none", cameras={"wrist": cameras.OakCameraConfig()})
    with pytest.raises(gf.DeviceError):
        robot.connect()
    assert not robot.is_connected
    assert not robot.cameras["wrist"].is_connected
