import contextlib
import os
import pty
import resource
import threading
import tty
from typing import Any

import dynamixel_sdk as sdk
import pytest

from gripper_force.errors import ConfigError, DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_hw.dynamixel.packets import Instruction, frame
from gripper_hw.dynamixel.port import open_port

PACKETS = sdk.PacketHandler(2.0)
PING = frame(1, Instruction.PING)


@pytest.mark.parametrize(
    ("name", "advice"),
    [("/dev/ttyNotThere", "plug it in"), ("virtual:nobody", "simulate one first")],
)
def test_missing_port_error_has_a_remedy(name, advice):
    with pytest.raises(DeviceNotFoundError, match=advice):
        open_port(name, 1_000_000, 4.0)


def test_regular_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="can't open"):
        open_port(str(tmp_path / "file"), 1_000_000, 4.0)


def test_unsupported_baud_rate_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="baud_rate 12345"):
        open_port(str(tmp_path), 12_345, 4.0)


def test_port_is_exclusive_until_closed(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    with pytest.raises(DeviceError, match="in use"):
        open_port(endpoint.port, 1_000_000, 250.0)
    port.closePort()
    port.closePort()
    open_port(endpoint.port, 1_000_000, 250.0).closePort()


def test_unplugged_port_raises_every_time_and_is_not_left_busy(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    assert PACKETS.ping(port, 1)[1] == sdk.COMM_SUCCESS
    endpoint.unplug()
    for _ in range(2):
        with pytest.raises(DeviceLostError, match="gone"):
            PACKETS.ping(port, 1)
        assert not port.is_using
    port.closePort()


def test_closed_port_raises_device_lost(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    port.closePort()
    with pytest.raises(DeviceLostError):
        PACKETS.ping(port, 1)


def test_drain_discards_an_earlier_reply(endpoint):
    port: Any = open_port(endpoint.port, 1_000_000, 250.0)
    port.writePort(PING)
    port.setPacketTimeoutMillis(100.0)
    port.drain()
    port.setPacketTimeoutMillis(1.0)
    assert port.readPort(100) == b""
    port.closePort()


def test_read_of_negative_length_is_empty(endpoint):
    port: Any = open_port(endpoint.port, 1_000_000, 250.0)
    port.writePort(PING)
    port.setPacketTimeoutMillis(1000.0)
    assert port.readPort(1) == b"\xff"
    assert port.readPort(-1) == b""
    assert port.readPort(1) == b"\xff"
    port.closePort()


def test_works_with_file_descriptors_above_1024(endpoint, tmp_path):
    with contextlib.ExitStack() as stack:
        file = stack.enter_context((tmp_path / "file").open("w"))
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 2048), hard))
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        last = 0
        while last < 1024:
            last = os.dup(file.fileno())
            stack.callback(os.close, last)
        port = open_port(endpoint.port, 1_000_000, 250.0)
        stack.callback(port.closePort)
        number, result, _ = sdk.PacketHandler(2.0).ping(port, 1)
        assert (number, result) == (1020, sdk.COMM_SUCCESS)


def test_reply_may_arrive_in_pieces(endpoint):
    port: Any = open_port(endpoint.port, 1_000_000, 100.0)
    port.writePort(PING)
    port.setPacketTimeout(14)
    found = b""
    while len(found) < 14:
        found += port.readPort(5)
    assert found[7] == 0x55
    assert port.readPort(0) == b""
    port.closePort()


@pytest.fixture
def deaf_port():
    """A port whose other end never reads."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = open_port(os.ttyname(slave), 57_600, 4.0)
    yield port
    port.closePort()
    os.close(master)
    os.close(slave)


def test_timeout_includes_both_packets_and_the_margin(deaf_port):
    deaf_port.writePort(PING)
    deaf_port.setPacketTimeout(100)
    assert deaf_port.packet_timeout == pytest.approx(110 * 10_000 / 57_600 + 4.0)


def test_endless_stream_of_bytes_is_abandoned():
    master, slave = pty.openpty()
    tty.setraw(slave)
    port: Any = open_port(os.ttyname(slave), 1_000_000, 4.0)
    done = threading.Event()

    def babble():
        while not done.is_set():
            os.write(master, bytes(64))

    thread = threading.Thread(target=babble)
    thread.start()
    # On a busy machine the other thread may be too late for one try.
    assert any(PACKETS.ping(port, 1)[1] == sdk.COMM_RX_CORRUPT for _ in range(50))
    port.drain()
    done.set()
    port.clearPort()  # otherwise the last write would block
    thread.join()
    port.closePort()
    os.close(master)
    os.close(slave)


def test_full_output_buffer_is_not_a_lost_port(deaf_port):
    while deaf_port.writePort(bytes(1000)):
        pass
    assert PACKETS.ping(deaf_port, 1)[1] == sdk.COMM_TX_FAIL
    assert not deaf_port.is_using
