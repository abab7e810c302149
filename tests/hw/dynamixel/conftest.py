"""A virtual bus behind either kind of port, with a clock set by the test and a record of received bytes."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from gripper_force.config import ServoConfig
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.packets import Packet, Parser
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus


class BusEndpoint:
    """A virtual bus and the port at which a client finds it.

    Attributes:
        bus: The bus.
        port: Name of the port.
        unplug: Unplugs the bus.
        now_ns: Time on the bus's clock.
        received: Bytes the bus received, one entry per call.
    """

    def __init__(self, bus: VirtualBus, port: str, unplug: Callable[[], None]) -> None:
        self.bus = bus
        self.port = port
        self.unplug = unplug
        self.now_ns = 0
        self.received: list[bytes] = []

    def packets(self) -> list[Packet]:
        """Every received instruction packet, in order."""
        parser = Parser()
        return [packet for data in self.received for packet in parser.feed(data)]

    def config(self, **values: object) -> ServoConfig:
        return ServoConfig.model_validate({"port": self.port, "reply_margin_ms": 250.0} | values)


class RecordingBus(VirtualBus):
    """Records received bytes in its endpoint."""

    endpoint: BusEndpoint

    def transact(self, data: bytes) -> bytes:
        self.endpoint.received.append(data)
        return super().transact(data)


MakeEndpoint = Callable[..., BusEndpoint]


def _make(stack: ExitStack, kind: str, *servos: VirtualServo) -> BusEndpoint:
    bus = RecordingBus(servos or [VirtualServo(1, load_model("XM430-W350"))], lambda: bus.endpoint.now_ns)
    if kind == "memory":
        register_bus("test", bus)
        stack.callback(unregister_bus, "test")
        bus.endpoint = BusEndpoint(bus, "virtual:test", lambda: unregister_bus("test"))
    else:
        server = stack.enter_context(PtyServer(bus))
        bus.endpoint = BusEndpoint(bus, server.device_path, server.unplug)
    return bus.endpoint


@pytest.fixture(params=["memory", "pty"])
def make_endpoint(request: pytest.FixtureRequest) -> Iterator[MakeEndpoint]:
    """Creates a bus of the given servos (default: one XM430-W350 with id 1), behind each kind of port."""
    with ExitStack() as stack:
        yield lambda *servos: _make(stack, request.param, *servos)


@pytest.fixture
def make_memory_endpoint() -> Iterator[MakeEndpoint]:
    """As `make_endpoint`, in memory only."""
    with ExitStack() as stack:
        yield lambda *servos: _make(stack, "memory", *servos)


@pytest.fixture
def endpoint(make_endpoint: MakeEndpoint) -> BusEndpoint:
    """One XM430-W350 with id 1, behind each kind of port."""
    return make_endpoint()


@pytest.fixture
def memory_endpoint(make_memory_endpoint: MakeEndpoint) -> BusEndpoint:
    """One XM430-W350 with id 1, in memory."""
    return make_memory_endpoint()
