"""Serves a virtual bus at a pseudo-terminal for any Dynamixel client, with a simple motor model."""

import contextlib
import fcntl
import os
import pty
import select
import termios
import threading
import time
import tty
from collections.abc import Iterable
from types import TracebackType
from typing import Final, Self

from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.virtual import VirtualBus

_IDLE_S: Final = 1.0
_STEP_NS: Final = 500_000  # integration step
_MAX_CATCH_UP_NS: Final = 250_000_000  # bounds the time to compute after a long pause


class PtyServer:
    """Serves a bus at `device_path` until closed. A context manager.

    Clients may connect and disconnect. Any baud rate works: bytes pass at once.

    Attributes:
        bus: The virtual bus.
        device_path: Path of the pseudo-terminal.
    """

    def __init__(self, bus: VirtualBus) -> None:
        self.bus = bus
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._wake_read, self._wake_write = os.pipe()
        self.device_path = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._serve, name="virtual-bus", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Ends serving like a pulled cable: the client's next access fails. May be called twice."""
        if not self._thread.is_alive():
            return
        os.write(self._wake_write, b"\0")
        self._thread.join()

    close = unplug

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        with contextlib.ExitStack() as handles:
            # Without an open slave the master would fail between two clients.
            for handle in (self._master, self._slave, self._wake_read, self._wake_write):
                handles.callback(os.close, handle)
            while True:
                ready, _, _ = select.select([self._master, self._wake_read], [], [], _IDLE_S)
                if self._wake_read in ready:
                    return
                if not ready:
                    # A serial port's exclusive mode ends with the process that set it. This one's would stay.
                    fcntl.ioctl(self._slave, termios.TIOCNXCL)
                    continue
                reply = self.bus.transact(os.read(self._master, 4096))
                with contextlib.suppress(BlockingIOError):  # like a real bus, it does not wait for readers
                    os.write(self._master, reply)


class BenchMotor:
    """Plant on a servo's horn, one degree of freedom: inertia, dry friction, and a spring at an angle.

    Attributes:
        position_rad: Angle of the horn.
        velocity_rad_s: Angular velocity of the horn.
    """

    def __init__(
        self,
        servo: VirtualServo,
        *,
        inertia_kg_m2: float = 0.003,
        friction_nm: float = 0.05,
        contact_rad: float | None = None,
        stiffness_nm_per_rad: float = 20.0,
    ) -> None:
        self.servo = servo
        self.position_rad = 0.0
        self.velocity_rad_s = 0.0
        self._inertia_kg_m2 = inertia_kg_m2
        self._friction_nm = friction_nm
        self._contact_rad = contact_rad
        self._stiffness_nm_per_rad = stiffness_nm_per_rad
        self._t_ns: int | None = None

    def advance(self, now_ns: int) -> None:
        """Advances motor and firmware to ``now_ns``; simulates at most the last 0.25 s."""
        t_ns = now_ns if self._t_ns is None else max(self._t_ns, now_ns - _MAX_CATCH_UP_NS)
        while t_ns + _STEP_NS <= now_ns:
            t_ns += _STEP_NS
            self._step(t_ns)
        self._t_ns = t_ns

    def _step(self, t_ns: int) -> None:
        step_s = _STEP_NS * 1e-9
        current_a = self.servo.control(t_ns, self.position_rad, self.velocity_rad_s)
        torque_nm = current_a * self.servo.model.nm_per_a
        if self._contact_rad is not None and self.position_rad > self._contact_rad:
            torque_nm -= self._stiffness_nm_per_rad * (self.position_rad - self._contact_rad)
        free_rad_s = self.velocity_rad_s + torque_nm / self._inertia_kg_m2 * step_s
        friction_rad_s = self._friction_nm / self._inertia_kg_m2 * step_s
        # Dry friction can stop the motion, but never reverse it.
        self.velocity_rad_s = max(0.0, abs(free_rad_s) - friction_rad_s) * (1 if free_rad_s > 0 else -1)
        self.position_rad += self.velocity_rad_s * step_s


def serve_virtual_servo(model_name: str, ids: Iterable[int] = (1,)) -> PtyServer:
    """Serves virtual servos, each with a `BenchMotor`, in real time.

    Args:
        model_name: Name of the model (see `load_model`).
        ids: Servo ids.

    Raises:
        ConfigError: The model is unknown, or has no current control.
    """
    model = load_model(model_name)
    motors = [BenchMotor(VirtualServo(id_, model)) for id_ in ids]

    def advance() -> None:
        now_ns = time.monotonic_ns()
        for motor in motors:
            motor.advance(now_ns)

    return PtyServer(VirtualBus((motor.servo for motor in motors), before_packet=advance))
