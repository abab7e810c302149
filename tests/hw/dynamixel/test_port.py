import contextlib
import os
import pty
import resource
import threading
import tty

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
def test_a_missing_port_says_what_to_do(name, advice):
    with pytest.raises(DeviceNotFoundError, match=advice):
        open_port(name, 1_000_000, 4.0)


def test_a_file_that_is_no_line_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="can't open"):
        open_port(str(tmp_path / "file"), 1_000_000, 4.0)


def test_an_odd_baud_rate_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="baud_rate 12345"):
        open_port(str(tmp_path), 12_345, 4.0)


def test_a_port_is_exclusive_until_closed(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    with pytest.raises(DeviceError, match="in use"):
        open_port(endpoint.port, 1_000_000, 250.0)
    port.closePort()
    port.closePort()
    open_port(endpoint.port, 1_000_000, 250.0).closePort()


def test_a_pulled_plug_is_told_each_time_and_leaves_no_port_busy(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    assert PACKETS.ping(port, 1)[1] == sdk.COMM_SUCCESS
    endpoint.unplug()
    for _ in range(2):
        with pytest.raises(DeviceLostError, match="gone"):
            PACKETS.ping(port, 1)
        assert not port.is_using
    port.closePort()


def test_a_closed_port_is_lost(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    port.closePort()
    with pytest.raises(DeviceLostError):
        PACKETS.ping(port, 1)


def test_what_was_received_before_is_not_the_next_answer(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    port.writePort(PING)
    port.setPacketTimeoutMillis(100.0)
    port.drain()
    port.setPacketTimeoutMillis(1.0)
    assert port.readPort(100) == b""
    port.closePort()


def test_the_sdk_may_ask_for_less_than_nothing(endpoint):
    port = open_port(endpoint.port, 1_000_000, 250.0)
    port.writePort(PING)
    port.setPacketTimeoutMillis(1000.0)
    assert port.readPort(1) == b"\xff"
    assert port.readPort(-1) == b""
    assert port.readPort(1) == b"\xff"
    port.closePort()


def test_a_program_with_many_files_open_reads_too(endpoint, tmp_path):
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


def test_an_answer_may_come_in_pieces(endpoint):
    port = open_port(endpoint.port, 1_000_000, 100.0)
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
    """A port whose other end reads nothing."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = open_port(os.ttyname(slave), 57_600, 4.0)
    yield port
    port.closePort()
    os.close(master)
    os.close(slave)


def test_the_time_for_an_answer_counts_both_packets_and_the_margin(deaf_port):
    deaf_port.writePort(PING)
    deaf_port.setPacketTimeout(100)
    assert deaf_port.packet_timeout == pytest.approx(110 * 10_000 / 57_600 + 4.0)


def test_a_line_that_never_falls_silent_is_given_up():
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = open_port(os.ttyname(slave), 1_000_000, 4.0)
    done = threading.Event()

    def babble():
        while not done.is_set():
            os.write(master, bytes(64))

    thread = threading.Thread(target=babble)
    thread.start()
    # On a busy machine the other thread may come too late for one try.
    assert any(PACKETS.ping(port, 1)[1] == sdk.COMM_RX_CORRUPT for _ in range(50))
    port.drain()
    done.set()
    port.clearPort()  # or the last write would wait for ever
    thread.join()
    port.closePort()
    os.close(master)
    os.close(slave)


def test_a_line_that_takes_no_more_is_not_lost(deaf_port):
    while deaf_port.writePort(bytes(1000)):
        pass
    assert PACKETS.ping(deaf_port, 1)[1] == sdk.COMM_TX_FAIL
    assert not deaf_port.is_using
