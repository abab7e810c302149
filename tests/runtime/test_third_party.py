"""Devices of other packages: what their code raises ends a run as any device's fault does."""

import json
import sys
import time
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DeviceError, DeviceTimeoutError
from gripper_force.jobs import doctor
from gripper_force.jobs.grasp import run_grasp
from gripper_force.plugins import load_class
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_run, open_session
from gripper_force.types import Event, Frame, GraspStatus, LoadCellSample, Phase, RequestKind, ServoState
from gripper_hw.dynamixel import virtual

DEVICES = """
import numpy as np

from gripper_force.interfaces import BusStats, ServoSpec
from gripper_force.types import Frame, ServoState

class Device:
    supports_lockstep = True
    calls = 0

    def __init__(self, config, clock):
        self.fails, self.clock = config.options["fails"], clock
        self.at("__init__")

    def at(self, method):
        if self.fails == method and (method in ("__init__", "start", "settings", "close") or self.calls > 9):
            raise ValueError(f"no {method}\\nhere")

    def result(self, method, right):
        return "nonsense" if self.fails == f"result of {method}" and self.calls > 9 else right

    def start(self):
        self.at("start")

    def counts(self):
        self.at("counts")
        return self.result("counts", {})

    def close(self):
        self.at("close")

class Cell(Device):
    def drain(self):
        self.calls += 1
        self.at("drain")
        return self.result("drain", [])

class Camera(Device):
    def newest(self):
        self.calls += 1
        self.at("newest")
        now_ns = self.clock.now_ns()
        frame = Frame(now_ns, now_ns, self.calls, np.full((48, 64), self.calls % 250, np.uint8))
        return self.result("newest", frame)

    def settings(self):
        self.at("settings")
        return {"gain": np.float32(2.5), "resolution_px": np.array([64, 48]), "mode": np.str_("day")}

class Servo(Device):
    stats = BusStats()
    stopped = []

    @staticmethod
    def spec(config):
        return ServoSpec(1.8, 0.00269, (10.0, 14.8))

    def start(self):
        return self.read()

    def read(self):
        self.at("read")
        return self.result("read", ServoState(self.clock(), 0.0, 0.0, 0.0, 30.0, 12.0, 0))

    def write(self, command):
        self.calls += 1
        self.at("write")

    def stop(self, *, hold):
        self.stopped.append(hold)
"""
UNITS = {"camera": "own_devices:Camera", "load_cell": "own_devices:Cell", "servo": "own_devices:Servo"}
REMEDY = "; it is no part of gripper-force: correct it, or tell its author$"


@pytest.fixture
def config(quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    (tmp_path / "own_devices.py").write_text(DEVICES)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_devices", raising=False)  # that of another test
    return load_config(None, [*quick, "log.report=false"])


def with_own(config: Config, unit: str, fails: str, **keys: object) -> Config:
    """With this device of another package; with such a servo in real time, without sensors."""
    if unit == "servo":
        none = {"backend": "none"}
        keys |= {"clock": "realtime", "camera": none, "load_cell": none}
    return config.with_values(**{unit: {"backend": UNITS[unit], "options": {"fails": fails}}}, **keys)


@pytest.mark.parametrize("unit", ["camera", "load_cell"])
@pytest.mark.parametrize("method", ["__init__", "start"])
def test_a_device_that_can_not_be_opened_is_named(
    config: Config, tmp_path: Path, unit: str, method: str
) -> None:
    named = UNITS[unit].partition(":")[2] + ("" if method == "__init__" else ".start")
    sentence = rf"^{unit}\.backend={UNITS[unit]}: {named}\(\) raised ValueError: no {method} here{REMEDY}"
    with pytest.raises(DeviceError, match=sentence):
        run_grasp(with_own(config, unit, method), tmp_path / "run.mcap")
    assert virtual.find_bus("rig") is None
    assert not (tmp_path / "run.mcap").exists()
    *_, last = doctor.check_unit(with_own(config, unit, method), unit.replace("_", " "))
    assert (last.ok, "raised ValueError" in last.found) == (False, True)


@pytest.mark.parametrize("unit", ["camera", "load_cell", "servo"])
@pytest.mark.parametrize("error", [None, ZeroDivisionError()])
def test_a_device_that_can_not_be_closed_hides_neither_result_nor_error(
    config: Config, tmp_path: Path, unit: str, error: Exception | None
) -> None:
    named = rf"{unit}\.backend={UNITS[unit]}: {UNITS[unit].partition(':')[2]}\.close\(\) raised ValueError: no close here"

    def run() -> None:
        own = with_own(config, unit, "close")
        with open_run(own, tmp_path / "run.mcap") as session:
            session.wait_for_reference()
            if error is not None:
                raise error

    with (
        pytest.warns(RuntimeWarning, match=f"^a device was not closed: {named}{REMEDY}"),
        nullcontext() if error is None else pytest.raises(ZeroDivisionError),
    ):
        run()
    assert virtual.find_bus("rig") is None  # closed after the device
    assert import_module("own_devices").Servo.stopped == ([False] if unit == "servo" else [])
    assert LogReader(tmp_path / "run.mcap").complete


@pytest.mark.parametrize(
    ("unit", "method"),
    [
        ("camera", "newest"),
        ("camera", "counts"),
        ("load_cell", "drain"),
        ("load_cell", "counts"),
        ("servo", "read"),
    ],
)
def test_a_method_that_returns_something_else_is_named(
    config: Config, tmp_path: Path, unit: str, method: str
) -> None:
    named = f"{UNITS[unit]}: {UNITS[unit].partition(':')[2]}"
    sentence = (
        rf"{unit}\.backend={named}\.{method}\(\) returned str; return what gripper_force\.interfaces says$"
    )
    with pytest.raises(DeviceError, match=sentence):
        run_grasp(with_own(config, unit, f"result of {method}"), tmp_path / "run.mcap")
    assert LogReader(tmp_path / "run.mcap").complete


@pytest.mark.parametrize(
    ("unit", "method"),
    [("camera", "newest"), ("camera", "counts"), ("load_cell", "drain"), ("load_cell", "counts")],
)
@pytest.mark.parametrize("on_fault", ["limp", "open"])
def test_a_device_that_fails_in_a_run_ends_it_as_configured(
    config: Config, tmp_path: Path, unit: str, method: str, on_fault: str
) -> None:
    path = tmp_path / "run.mcap"
    settings = resolve(with_own(config, unit, method, control={"on_fault": on_fault}))
    with open_devices(settings.config) as devices:
        bus = virtual.find_bus("rig")
        assert bus is not None
        with (
            pytest.raises(DeviceError, match=rf"\.{method}\(\) raised ValueError: no {method} here{REMEDY}"),
            open_session(settings, devices, path) as session,
        ):
            while True:
                session.cycle()
        assert bus.servos[0].get("torque_enable") == 0
    log = LogReader(path)
    assert log.complete
    told = [event.text for event in log.records(Event)]
    assert any(text.startswith(f"DeviceError: {unit}.backend={UNITS[unit]}") for text in told)
    assert len(list(log.records(GraspStatus))) >= 9


@pytest.mark.parametrize(("unit", "method"), [("camera", "counts"), ("load_cell", "drain")])
def test_the_jaws_open_after_a_fault_although_a_sensor_fails_again(
    config: Config, tmp_path: Path, unit: str, method: str
) -> None:
    path = tmp_path / "run.mcap"
    settings = resolve(with_own(config, unit, "", control={"on_fault": "open"}))
    with open_devices(settings.config) as devices:
        with pytest.raises(DeviceError, match=method), open_session(settings, devices, path) as session:
            session.wait_for_reference()
            status = session.cycle(RequestKind.GRASP, 3.0).status
            while status.phase != Phase.HOLD:
                status = session.cycle().status
            getattr(devices, unit)._part.fails = method
            session.cycle()
        assert list(LogReader(path).records(GraspStatus))[-1].width_m > 0.085


@pytest.mark.parametrize(
    ("unit", "method"), [("camera", "counts"), ("camera", "settings"), ("load_cell", "drain")]
)
def test_a_sensor_that_fails_at_the_end_does_not_hide_the_error_before(
    config: Config, unit: str, method: str
) -> None:
    settings = resolve(with_own(config, unit, ""))
    with (
        open_devices(settings.config) as devices,
        pytest.raises(ZeroDivisionError),
        open_session(settings, devices, None) as session,
    ):
        session.wait_for_reference()
        getattr(devices, unit)._part.fails = method
        raise ZeroDivisionError


def test_the_settings_of_a_camera_may_be_of_numpy(config: Config, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_run(with_own(config, "camera", ""), path) as session:
        session.wait_for_reference()
    assert len(list(LogReader(path).records(Frame))) > 10
    settings = json.loads(LogReader(path).attachments["camera.json"])
    assert settings == {"gain": 2.5, "resolution_px": [64, 48], "mode": "day"}


def test_an_attribute_settings_of_a_camera_is_its_own(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    settings = resolve(with_own(config, "camera", ""))
    with open_devices(settings.config) as devices:
        camera: Any = devices.camera
        monkeypatch.setattr(camera._part, "settings", {"gain": 2})
        with open_session(settings, devices, path) as session:
            session.wait_for_reference()
    assert "camera.json" not in LogReader(path).attachments


def test_settings_that_fail_do_not_cost_the_log(config: Config, tmp_path: Path) -> None:
    with (
        pytest.raises(DeviceError, match=r"Camera\.settings\(\) raised ValueError: no settings here"),
        open_run(with_own(config, "camera", "settings"), tmp_path / "run.mcap") as session,
    ):
        session.wait_for_reference()
    assert LogReader(tmp_path / "run.mcap").complete


@pytest.mark.parametrize("fails", ["settings", ""])
def test_a_camera_at_the_end_does_not_hide_a_servo_that_does_not_stop(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    def stop(*, hold: bool) -> None:
        raise DeviceError("the servo does not answer")

    path = tmp_path / "run.mcap"
    settings = resolve(with_own(config, "camera", fails))
    with open_devices(settings.config) as devices:
        with (
            pytest.raises(DeviceError, match=r"^the servo does not answer"),
            open_session(settings, devices, path) as session,
        ):
            session.cycle()
            monkeypatch.setattr(devices.servo, "stop", stop)
        monkeypatch.undo()
    assert ("camera.json" in LogReader(path).attachments) == (not fails)


def test_a_servo_that_fails_is_told_to_stop(config: Config, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    own = with_own(config, "servo", "write")
    with pytest.raises(DeviceError, match=rf"^servo\.backend=own_devices:Servo: Servo\.write\(\) .*{REMEDY}"):
        run_grasp(own, path)
    assert import_module("own_devices").Servo.stopped == [False]
    assert LogReader(path).complete


def test_a_servo_whose_start_returns_nothing_is_told_to_stop(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = with_own(config, "servo", "nothing")
    servo = import_module("own_devices").Servo
    monkeypatch.setattr(servo, "start", lambda self: None)
    with pytest.raises(
        DeviceError,
        match=r"^servo\.backend=own_devices:Servo: start\(\) returned NoneType; return a ServoState",
    ):
        run_grasp(own, tmp_path / "run.mcap")
    assert servo.stopped == [False]


FRAME = "a Frame whose "
SAMPLE = "a LoadCellSample whose "
STATE = "a ServoState whose "
IMAGE = "not an image, \\(H, W\\) uint8"
OTHER_CLOCK = "s from the present: use the clock that the class gets, in nanoseconds"
RECORDS: list[tuple[str, str, str, str]] = [
    (
        "camera",
        "newest",
        "Frame(now, now, 1, np.zeros((4, 5, 3), np.uint8))",
        rf"{FRAME}gray is uint8 \(4, 5, 3\), {IMAGE}",
    ),
    (
        "camera",
        "newest",
        "Frame(now, now, 1, np.zeros((4, 5)))",
        rf"{FRAME}gray is float64 \(4, 5\), {IMAGE}",
    ),
    ("camera", "newest", "Frame(now, now, 1, None)", f"{FRAME}gray is NoneType, {IMAGE}"),
    ("camera", "newest", "Frame(now, now, -1, gray)", f"{FRAME}seq is -1, not a whole number of 0 or more"),
    ("camera", "newest", "Frame(-1, now, 1, gray)", f"{FRAME}t_ns is -1, not a whole number of 0 or more"),
    ("camera", "newest", "Frame(now, now / 1e9, 1, gray)", f"{FRAME}received_ns is .*, not a whole number"),
    (
        "camera",
        "newest",
        "Frame(time.time_ns(), now, 1, gray)",
        rf"{FRAME}t_ns is \d+, \+.* {OTHER_CLOCK}",
    ),
    ("camera", "newest", "(now, now, 1, gray)", "tuple"),
    ("camera", "counts", "{'lost': '3'}", r"{'lost': '3'}, which is no name with a whole number"),
    ("load_cell", "drain", "[None]", "NoneType"),
    ("load_cell", "drain", "[LoadCellSample(now, '1', 1.0)]", f"{SAMPLE}force_n is '1', not a number"),
    (
        "load_cell",
        "drain",
        "[LoadCellSample(now, float('nan'), 1.0)]",
        "a valid LoadCellSample whose force_n is nan, ",
    ),
    (
        "load_cell",
        "drain",
        "[LoadCellSample(now + 10**11, 1.0, 1.0)]",
        rf"{SAMPLE}t_ns is \d+, \+100 {OTHER_CLOCK}",
    ),
    ("servo", "read", "(now, 0.0)", "tuple"),
    (
        "servo",
        "read",
        "ServoState(now, None, 0.0, 0.0, 30.0, 12.0, 0)",
        f"{STATE}position_rad is None, not a number",
    ),
    (
        "servo",
        "read",
        "ServoState(now // 10**9, 0.0, 0.0, 0.0, 30.0, 12.0, 0)",
        rf"{STATE}t_ns is \d+, -.* {OTHER_CLOCK}",
    ),
    ("servo", "read", "type('ServoState', (), {'__module__': 'own'})()", "ServoState"),
]


@pytest.mark.parametrize(("unit", "method", "result", "sentence"), RECORDS)
def test_a_record_with_a_wrong_field_ends_the_run_at_once(
    config: Config,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    unit: str,
    method: str,
    result: str,
    sentence: str,
) -> None:
    path = tmp_path / "run.mcap"
    own = with_own(config, unit, "")
    module = import_module("own_devices")
    right = getattr(getattr(module, UNITS[unit].partition(":")[2]), method)

    def wrong(self: Any) -> object:
        right_result = right(self)
        if self.calls < 10:
            return right_result
        now = self.clock() if unit == "servo" else self.clock.now_ns()
        names = {"now": now, "np": np, "time": time, "gray": np.zeros((4, 5), np.uint8)}
        return eval(
            result, {**names, "Frame": Frame, "LoadCellSample": LoadCellSample, "ServoState": ServoState}
        )

    monkeypatch.setattr(getattr(module, UNITS[unit].partition(":")[2]), method, wrong)
    name = UNITS[unit]
    with pytest.raises(
        DeviceError,
        match=rf"^{unit}\.backend={name}: {name.partition(':')[2]}\.{method}\(\) returned {sentence}",
    ):
        run_grasp(own, path)
    assert LogReader(path).complete
    assert module.Servo.stopped == ([False] if unit == "servo" else [])


def test_a_servo_whose_time_stands_still_ends_the_run(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = with_own(config, "servo", "")
    servo = import_module("own_devices").Servo
    state = ServoState(time.monotonic_ns(), 0.0, 0.0, 0.0, 30.0, 12.0, 0)
    monkeypatch.setattr(servo, "read", lambda self: state)
    with pytest.raises(DeviceTimeoutError, match=r"^the servo's t_ns stands still; "):
        run_grasp(own, tmp_path / "run.mcap")
    assert servo.stopped == [False]


def test_a_servo_without_counters_is_named(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    own = resolve(with_own(config, "servo", ""))
    monkeypatch.setattr(import_module("own_devices").Servo, "stats", None)
    with (
        pytest.raises(
            DeviceError,
            match=r"Servo\.stats\(\) returned NoneType; return what gripper_force\.interfaces says$",
        ),
        open_devices(own.config),
    ):
        pass
    monkeypatch.delattr(import_module("own_devices").Servo, "stats")
    with pytest.raises(DeviceError, match=r"Servo\.stats\(\) returned NoneType"), open_devices(own.config):
        pass


def test_an_engine_and_a_module_that_fail_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_engine.py").write_text(
        "class Engine:\n    def __init__(self, *_): 1 / 0\n    step = warm_up = reset = print\n"
    )
    (tmp_path / "own_module.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    engine = load_class("engines", {}, "own_engine:Engine", "vision.engine")
    with pytest.raises(ConfigError, match=r"^vision\.engine=own_engine:Engine: Engine\(\) raised ZeroDiv"):
        engine(None, "float32", 1)
    with pytest.raises(ConfigError, match=r"can't import 'own_module': division by zero; "):
        load_class("engines", {}, "own_module:Engine", "vision.engine")


EYES = """
import numpy as np

from gripper_force.vision.engines import Engine, StepOutput

class Eyes(Engine):
    def __init__(self, model, precision, threads):
        super().__init__(model.header)

    def _zero_states(self): ...

    def _infer(self, frame):
        members = self.header.members
        forces_n = np.zeros(len(members), np.float32)
        features = np.zeros(sum(member.head for member in members), np.float32)
        return {result}
"""
NO_ARRAYS = rf"^vision\.engine=own_eyes:Eyes: Eyes\.warm_up\(\) raised TypeError: forces_n and features must be NumPy arrays of floats of 1 dimension, .*{REMEDY}"


@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (
            "forces_n",
            r"^vision\.engine=own_eyes:Eyes: Eyes\.step\(\) returned ndarray; return what gripper_force\.vision\.engines\.Engine says$",
        ),
        (
            "StepOutput(forces_n, features[1:], None)",
            r"the engine gave \(2, 13\) forces and features, not \(2, 14\); ",
        ),
        ("StepOutput(forces_n.tolist(), features, None)", NO_ARRAYS),
        ("StepOutput(forces_n, features[None], None)", NO_ARRAYS),
        ("StepOutput(forces_n, features, features)", NO_ARRAYS),
    ],
)
def test_an_engine_that_returns_something_else_is_named(
    quick_vision: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, result: str, sentence: str
) -> None:
    (tmp_path / "own_eyes.py").write_text(EYES.replace("{result}", result))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_eyes", raising=False)
    config = load_config(None, [*quick_vision, "vision.engine=own_eyes:Eyes", "log.report=false"])
    with pytest.raises(ConfigError, match=sentence):
        run_grasp(config, tmp_path / "run.mcap")
    assert virtual.find_bus("rig") is None
