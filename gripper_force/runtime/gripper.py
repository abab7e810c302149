"""The public interface of a live gripper: `open_gripper` and `Gripper`."""

from __future__ import annotations

import weakref
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, overload

from gripper_force.config import Config, Overrides, config_from, load_config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Lock, SharedPort
from gripper_force.runtime.control_loop import ControlLoop
from gripper_force.runtime.requests import PendingRequest
from gripper_force.runtime.state import GraspResult, GripperState
from gripper_force.schema import as_path
from gripper_force.types import Frame, LoadCellSample, RequestKind


def open_gripper(
    config: Config | str | Path | None = None,
    *,
    log: str | Path | None = None,
    overrides: Overrides | None = None,
    background: bool | None = None,
    port: Any = None,
    port_lock: Lock | None = None,
) -> Gripper:
    """Opens the configured gripper, arms its servo, and waits for the first frames.

    Nothing moves before the first request. Use the result in a ``with`` block, or call `Gripper.close`.

    Example::

        with open_gripper("my.yaml", log="run.mcap") as gripper:
            result = gripper.grasp(4.0)
            gripper.set_force(2.0)
            gripper.release()

    Args:
        config: A configuration, or the path of its YAML file; None: the defaults, which are a simulated rig.
        log: MCAP file to write; it must not exist. None: no log.
        overrides: Configuration keys to change: ``{"control.rate_hz": 100}`` or ``["control.rate_hz=100"]``.
        background: True: a thread runs the control cycle. False: the caller does, with `Gripper.step`.
            None: True in real time, False in lockstep.
        port: A port that is already open and that other code uses, too, such as an arm's program: a
            ``dynamixel_sdk.PortHandler`` or an object with the same methods. Packets are sent only to
            ``servo.id``, and the port is neither configured nor closed. None: opens ``servo.port``.
        port_lock: Lock of a shared port, such as a `threading.Lock`. Every user of the port holds it for one
            transaction, a request and its replies. If it is not free within ``servo.bus_watchdog_ms``, the run ends
            with `DeviceTimeoutError`.

    Raises:
        ConfigError: A key, value, profile or backend is wrong, ``background`` is True in lockstep, or a port
            is given without a lock.
        DeviceError: A device is missing, in use, or does not answer.
        SimulationError: The simulated scene cannot be built.
        LogError: The log cannot be written.
        CheckpointError: The network's file is missing, damaged, or of another network.
        DataError: The first frames gave no estimate, or the log to play holds no frames.
        RequestError: Another thread closed the gripper meanwhile.
    """
    if isinstance(config, Config):
        if overrides:
            raise ConfigError("overrides change a file or the defaults; pass them to load_config instead")
        settings = config_from(config.model_dump(warnings=False), "open_gripper")  # copies are not checked
    else:
        settings = load_config(config, overrides)
    lockstep = settings.clock == "lockstep"
    if lockstep and background:
        raise ConfigError(
            "clock=lockstep runs in the caller's thread; leave background out, or set clock=realtime"
        )
    background = not lockstep if background is None else background
    is_shared = port is not None or port_lock is not None
    if is_shared and not (hasattr(port, "writePort") and hasattr(port_lock, "acquire")):
        raise ConfigError("a shared port needs port, an open PortHandler, and port_lock, a Lock; pass both")
    shared = None if port is None or port_lock is None else SharedPort(port, port_lock)
    path = None if log is None else as_path(log, "the log")
    loop = ControlLoop(settings, path, background=background, port=shared)
    loop.open()
    return Gripper(loop, path)


class Gripper:
    """A gripper that holds objects with a requested force. Made by `open_gripper`.

    In real time a background thread runs the control cycle, and every method and attribute may be used from
    any thread. In lockstep, or with ``background=False``, the blocking methods run the cycle in the caller's
    thread; between them the caller runs it with `step` or `sleep`. A call of another thread that would run it
    meanwhile raises `RequestError`; requests with ``wait=False``, `stop` and `close` do not. In real time the servo's
    Bus Watchdog stops the servo if no cycle runs for ``servo.bus_watchdog_ms``.

    A newer request replaces an older one: a call that waits for one of another kind raises `RequestError`, and one
    that waits for the same kind gets the newer one's result. `stop` always wins, and `close` raises `RequestError` in
    each call that waits. A refused request raises `RequestError`, a failed device `DeviceError`, a simulation that is
    too slow for real time `SimulationError`.

    However the gripper is closed, the servo is left as configured: as ``on_exit`` says, or as ``control.on_fault`` says
    after a fault, a stop or an exception. A gripper with a background thread is also closed once nothing refers to it.
    Ctrl-C in a call that waits while the jaws close stops them, or ends the run without a background thread.

    Once the run has ended, every method but `close`, and every newest value, raises the error that ended it, or
    `RequestError` after `close`.

    In asyncio, call the blocking methods in a thread: ``await asyncio.to_thread(gripper.grasp, 4.0)``.

    Attributes:
        config: The complete configuration: profiles applied, every ``auto`` resolved.
        log: The log's path, or None.
    """

    def __init__(self, loop: ControlLoop, log: Path | None) -> None:
        self._loop, loop.owner = loop, weakref.ref(self, loop.lose)
        self._resolved = loop.session.resolved
        self.config, self.log = self._resolved.config, log

    # Requests.

    @overload
    def grasp(
        self, force_n: float, *, wait: Literal[True] = True, new_object: bool = False
    ) -> GraspResult: ...
    @overload
    def grasp(self, force_n: float, *, wait: bool, new_object: bool = False) -> GraspResult | None: ...
    def grasp(self, force_n: float, *, wait: bool = True, new_object: bool = False) -> GraspResult | None:
        """Closes the jaws on an object and holds it with a force. If an object is held, changes the force.

        Args:
            force_n: Target force, in newtons: more than 0, at most 0.9 times ``control.force_limit_n`` over
                ``gripper.gain_bound`` (less with a linkage, see `largest_force_n`), and at most what the profiles were
                calibrated with.
            wait: False returns at once; `state` shows the progress.
            new_object: True if the camera sees another object than in the grasps before, or was moved since: the
                newest frames become the reference of vision, and the gain that was learned is forgotten. The jaws must
                not touch the object yet.

        Returns:
            The result once the outcome is known; None with ``wait=False``.

        Raises:
            RequestError: The force is out of range, the gripper is at fault and needs a release first, or
                ``new_object`` is True while an object is held.
            DeviceError: A device failed.
        """
        self._resolved.check_target(force_n)
        request = PendingRequest(RequestKind.GRASP, float(force_n), new_object=new_object, is_awaited=wait)
        return self._loop.request(request)

    @overload
    def set_force(self, force_n: float, *, wait: Literal[True] = True) -> GraspResult: ...
    @overload
    def set_force(self, force_n: float, *, wait: bool) -> GraspResult | None: ...
    def set_force(self, force_n: float, *, wait: bool = True) -> GraspResult | None:
        """Raises or lowers the force on a gripped object, without letting go.

        A stream of targets with ``wait=False`` is followed: a ramp in progress takes a new target without a stop, and
        one within 1 % (at least 0.025 N) of the present target changes nothing. For a target that is lower by at most
        4 % (at least 0.1 N), which friction can hide, the jaws do not open.

        Args:
            force_n: New target force, in newtons; limits as in `grasp`.
            wait: False returns at once.

        Returns:
            The result once the new force is held or the outcome is another; None with ``wait=False``.

        Raises:
            RequestError: No object is gripped, or the force is out of range.
            DeviceError: A device failed.
        """
        self._resolved.check_target(force_n)
        request = PendingRequest(RequestKind.GRASP, float(force_n), needs_object=True, is_awaited=wait)
        return self._loop.request(request)

    def move(self, width_m: float, *, wait: bool = True) -> float:
        """Moves the jaws to a width, and lets go of an object if one is gripped.

        The jaws move with the speed of a release (see ``control.approach_speed_m_s``), with a motor force of
        ``control.approach_force_n`` plus friction. After the impact, they press on an obstacle with
        ``control.approach_force_n`` plus the error of ``gripper.friction_n``. On an object that they held, that can be
        more by twice the friction. All of it is below ``control.force_limit_n``. A stream of widths with
        ``wait=False`` is followed: a move in progress takes a new width without a stop.

        Args:
            width_m: Distance between the jaws, in metres: 0 to ``gripper.open_width_m``.
            wait: False returns at once.

        Returns:
            The width reached, in metres; the present width with ``wait=False``. `state` has the outcome:
            ``moved``, or ``blocked``: an obstacle or friction stopped the jaws.

        Raises:
            RequestError: The width is out of range, or the gripper is at fault and needs a release first.
            DeviceError: A device failed.
        """
        self._resolved.check_width(width_m)
        self._loop.request(PendingRequest(RequestKind.MOVE, width_m=float(width_m), is_awaited=wait))
        return self.width_m

    def release(self, *, wait: bool = True) -> float:
        """Opens the jaws. After a fault or a stop it also resets the fault, once its cause is gone.

        Args:
            wait: False returns at once.

        Returns:
            The width reached, in metres. If the jaws did not open, the outcome of `state` is ``blocked``, and its
            reason names what to check.

        Raises:
            RequestError: The cause of a fault persists.
            DeviceError: A device failed.
        """
        self._loop.request(PendingRequest(RequestKind.RELEASE, is_awaited=wait))
        return self.width_m

    def stop(self) -> None:
        """Stops the gripper within one control cycle, as ``control.on_fault`` says. Any thread may call it.

        The gripper is then at fault: a waiting `grasp` returns the outcome ``fault``, and only `release`
        resets it. With ``background=False`` the stop takes effect in the next `step`.

        Raises:
            RequestError: The gripper is closed.
            DeviceError: A device failed, which has ended the run.
        """
        self._loop.stop()

    # The control cycle in the caller's thread.

    def step(self) -> GripperState:
        """Runs one control cycle in the caller's thread, when it is due.

        Returns:
            The state after the cycle.

        Raises:
            RequestError: A background thread runs the cycle, or the gripper is closed.
            DeviceError: A device failed.
        """
        return self._loop.step()

    def sleep(self, seconds: float) -> None:
        """Lets the gripper work for a time: waits in real time, runs control cycles in lockstep.

        Args:
            seconds: Time on the run's clock.

        Raises:
            RequestError: The gripper is closed, or the time is not a number of 0 to 1e9.
            DeviceError: A device failed meanwhile.
        """
        self._loop.sleep(seconds)

    # Newest values. None of them blocks. All raise the error that ended the run: a program that polls must notice it.

    @property
    def state(self) -> GripperState:
        """State after the newest control cycle. Its outcome is empty once a grasp or a move was requested.

        Raises:
            RequestError: The gripper is closed.
            DeviceError: A device failed, which has ended the run.
        """
        return self._loop.shown_state()

    @property
    def force_n(self) -> float:
        """Estimated contact force, in newtons."""
        return self.state.force_n

    @property
    def width_m(self) -> float:
        """Distance between the jaws, in metres."""
        return self.state.width_m

    @property
    def largest_force_n(self) -> float:
        """Largest force that `grasp` accepts, in newtons."""
        return self._resolved.largest_target_n

    @property
    def frame(self) -> Frame | None:
        """The newest camera frame, (H, W) uint8 in its ``gray``; None without a camera."""
        return self._loop.live_session().newest_frame

    @property
    def load_cell(self) -> LoadCellSample | None:
        """The newest valid load cell sample; None without a load cell."""
        return self._loop.live_session().last_load_cell_sample

    # The end.

    def close(self) -> None:
        """Ends the run: the servo is left as configured, devices and log are closed. May be called twice.

        Raises:
            DeviceError: A device failed since the last call, or the servo could not be stopped.
            LogError: Records are missing from the log.
        """
        self._loop.close(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.close(error)
