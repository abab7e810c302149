import dynamixel_sdk
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_hw.dynamixel.packets import Instruction, Packet, Parser, crc16, frame, status, stuff, unstuff

SDK = dynamixel_sdk.PacketHandler(2.0)

stuffy = st.lists(st.sampled_from([b"\xff", b"\xff\xff\xfd", b"\xfd", b"\x00", b"\x01"]), max_size=30).map(
    b"".join
)
contents = st.binary(max_size=60) | stuffy


class Tap(dynamixel_sdk.PortHandler):  # type: ignore[misc]
    """Records the bytes that the SDK sends."""

    def __init__(self) -> None:
        super().__init__("tap")
        self.sent = b""

    def clearPort(self):  # noqa: N802
        pass

    def writePort(self, packet):  # noqa: N802
        self.sent = bytes(packet)
        return len(packet)


@given(contents)
def test_crc_matches_the_sdk(data):
    assert crc16(data) == SDK.updateCRC(0, data, len(data))


@given(contents)
def test_stuffing_removes_headers_and_is_reversible(data):
    assert b"\xff\xff\xfd\x00" not in stuff(data)
    assert unstuff(stuff(data)) == data


@given(st.integers(0, 252), contents)
def test_frames_match_the_sdk(id_, data):
    data = b"\x01" + data
    tap = Tap()
    SDK.writeTxOnly(tap, id_, 0x1234, len(data), list(data))
    if b"\xff\xff\xfd" not in data:
        assert tap.sent == frame(id_, Instruction.WRITE, b"\x34\x12" + data)
    # The SDK stuffs a copy and sends the original, so stuffed data are compared before they are sent.
    unstuffed = [*frame(id_, Instruction.WRITE)[:7], Instruction.WRITE, 0x34, 0x12, *data, 0, 0]
    unstuffed[5:7] = (len(data) + 5).to_bytes(2, "little")
    assert bytes(SDK.addStuffing(unstuffed))[:-2] == frame(id_, Instruction.WRITE, b"\x34\x12" + data)[:-2]


@given(st.lists(st.tuples(st.integers(0, 252), contents), max_size=4), stuffy, st.data())
@settings(deadline=None)
def test_parser_finds_packets_in_garbage_and_any_split(packets, garbage, data):
    noise = garbage.replace(b"\xff\xff\xfd\x00", b"")
    stream = noise + b"\x01".join(frame(id_, Instruction.WRITE, params) for id_, params in packets)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=5)))
    parser = Parser()
    found = [
        packet
        for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True)
        for packet in parser.feed(stream[start:end])
    ]
    assert found == [Packet(id_, Instruction.WRITE, params) for id_, params in packets]


def test_corrupt_packet_is_marked_and_the_next_one_found():
    good = frame(1, Instruction.PING)
    found = list(Parser().feed(good[:-1] + b"\x00" + good))
    assert [packet.intact for packet in found] == [False, True]


def test_corrupt_length_does_not_hide_the_next_packet():
    good = frame(1, Instruction.PING)
    longer = good[:5] + b"\x0a" + good[6:]  # the length includes the following bytes
    found = list(Parser().feed(longer + good))
    assert found[-1] == Packet(1, Instruction.PING, b"")
    assert list(Parser().feed(good[:5] + b"\xff\xff" + good[7:] + good))[-1].intact


def test_status_packet_matches_the_vendors_example():
    # Protocol 2.0, status packet of a ping: id 1, model number 1030, firmware 38.
    assert status(1, 0, bytes.fromhex("060426")).hex(" ") == "ff ff fd 00 01 07 00 55 00 06 04 26 65 5d"
