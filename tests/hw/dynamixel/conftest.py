"""A virtual bus behind either kind of port, with a clock that stands still and a record of what it heard."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from gripper_force.config import ServoConfig
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.packets import Packet, Parser
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus


class Line:
    """A bus, the name of the port that leads to it, and a way to pull its plug."""

    def __init__(self, bus: VirtualBus, port: str, unplug: Callable[[], None]) -> None:
        self.bus = bus
        self.port = port
        self.unplug = unplug
        self.now_ns = 0
        self.heard: list[bytes] = []

    def packets(self) -> list[Packet]:
        """Every instruction packet so far, in order."""
        parser = Parser()
        return [packet for data in self.heard for packet in parser.feed(data)]

    def config(self, **values: object) -> ServoConfig:
        return ServoConfig.model_validate({"port": self.port, "reply_margin_ms": 250.0} | values)


class RecordingBus(VirtualBus):
    """Tells its line what it hears."""

    line: Line

    def transact(self, data: bytes) -> bytes:
        self.line.heard.append(data)
        return super().transact(data)


MakeLine = Callable[..., Line]


def _make(stack: ExitStack, kind: str, *servos: VirtualServo) -> Line:
    bus = RecordingBus(servos or [VirtualServo(1, load_model("XM430-W350"))], lambda: bus.line.now_ns)
    if kind == "memory":
        register_bus("test", bus)
        stack.callback(unregister_bus, "test")
        bus.line = Line(bus, "virtual:test", lambda: unregister_bus("test"))
    else:
        server = stack.enter_context(PtyServer(bus))
        bus.line = Line(bus, server.device_path, server.unplug)
    return bus.line


@pytest.fixture(params=["memory", "pty"])
def make_line(request: pytest.FixtureRequest) -> Iterator[MakeLine]:
    """Builds a line of servos (one XM430-W350 with id 1 if none is given), behind each kind of port."""
    with ExitStack() as stack:
        yield lambda *servos: _make(stack, request.param, *servos)


@pytest.fixture
def make_memory_line() -> Iterator[MakeLine]:
    """As `make_line`, in memory only."""
    with ExitStack() as stack:
        yield lambda *servos: _make(stack, "memory", *servos)


@pytest.fixture
def line(make_line: MakeLine) -> Line:
    """One XM430-W350 with id 1, behind each kind of port."""
    return make_line()


@pytest.fixture
def memory_line(make_memory_line: MakeLine) -> Line:
    """One XM430-W350 with id 1, in memory."""
    return make_memory_line()
