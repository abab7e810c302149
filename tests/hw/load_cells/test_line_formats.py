import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_hw.load_cells.line_formats import (
    HX711_MAX,
    HX711_MIN,
    MAX_LINE_BYTES,
    PARSERS,
    LineSplitter,
    Reading,
    parse_cas,
    parse_hx711,
)

numbers = st.decimals(-999, 9999, places=3).map(lambda kg: b"%8.3f" % kg)


@st.composite
def frames(draw: st.DrawFn) -> tuple[bytes, str, bytes]:
    """A frame without its line feed, its state and its number."""
    number, state = draw(numbers), draw(st.sampled_from(["ST", "US", "OL"]))
    head = state.encode() + b"," + draw(st.sampled_from([b"GS", b"NT"])) + b","
    identity = bytes([draw(st.integers(0x30, 0x7F)), draw(st.integers(0x80, 0xFF))])
    size = draw(st.sampled_from([22, 18, 10]))
    if size == 22:
        return head + identity + b"," + number + b" kg\r", state, number
    return (head + number + b"kg\r", state, number) if size == 18 else (number + b"\r", "ST", number)


def like_frames() -> st.SearchStrategy[bytes]:
    parts = [b"ST,", b"OL,", b"GS,", b"1\xc4,", b"   0.135", b" kg", b"12", b",", b"-", b"\r", b"nan", b"1e9"]
    return st.lists(st.sampled_from(parts), max_size=8).map(b"".join)


@given(st.sampled_from(sorted(PARSERS)), st.one_of(st.binary(max_size=40), like_frames()))
def test_any_bytes_give_a_reading_or_none(form: str, line: bytes) -> None:
    reading = PARSERS[form](line)
    assert reading is None or reading.saturated or math.isfinite(reading.raw)


@given(
    st.integers(HX711_MIN, HX711_MAX), st.none() | st.integers(0, 2**32), st.sampled_from(["", "\r", " \r"])
)
def test_counts_are_parsed_with_and_without_board_time(raw: int, micros: int | None, end: str) -> None:
    line = f"{raw}{end}" if micros is None else f"{micros},{raw}{end}"
    assert parse_hx711(line.encode()) == Reading(raw, saturated=raw in (HX711_MIN, HX711_MAX))


def test_scaled_values_of_boards_are_parsed() -> None:
    for line, raw in [
        (b"12.34\r", 12.34),
        (b"Weight: -0.50 g", -0.5),
        (b"Load_cell output val: 12.34\r", 12.34),
        (b"reading:\t-8.1", -8.1),
        (b"HX711 reading: 12.34", 12.34),
        (b"Load cell 1 (N) = 3.1 N", 3.1),
        (b"one reading:\t-0.4\t| average:\t-0.2\r", -0.4),
        (b"Weight: 12 g\r", 12.0),
        # SparkFun's OpenScale with and without its time, raw counts and temperatures.
        (b"1245,0.31,lbs,\r", 0.31),
        (b"-0.0312,kg,\r", -0.0312),
        (b"3,kg,", 3.0),
        (b"77,12.34,kg,8355808,24.50,0,\r", 12.34),
        (b"77,12.34,kg\r", 12.34),
    ]:
        assert parse_hx711(line) == Reading(raw, rounded=True)
    # The basic example of https://github.com/bogde/HX711 has digits in its name.
    for line in (b"HX711 reading: 4711\r", b"Reading: 4711", b"raw 4711"):
        assert parse_hx711(line) == Reading(4711.0)


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"8388608", b"-8388609", b"1,2,3", b"12 34", b"ready", b"1_0", b"1.2.3"),
        *(b"HX711 not found.", b"HX711 Demo", b"a: b: 12", b"| 12", b"x=1 y=2"),
    ],
)
def test_invalid_hx711_line_gives_no_reading(line: bytes) -> None:
    assert parse_hx711(line) is None


@given(frames())
def test_frames_of_all_three_lengths_are_parsed(frame: tuple[bytes, str, bytes]) -> None:
    line, state, number = frame
    assert parse_cas(line) == Reading(float(number), saturated=state == "OL", rounded=True)


@pytest.mark.parametrize(
    ("line", "raw"),
    [
        (b"ST,GS,1\xc4,+000.135 kg", 0.135),
        (b"US,NT,1\x8d,-  0.012 kg", -0.012),
        (b"ST,GS,1\xc4,000013.5 kg", 13.5),
        (b"ST,GS,1\xc4,     135  g", 0.135),
        (b"ST,NT,+    135g ", 0.135),
    ],
)
def test_number_formats_of_indicators_are_parsed(line: bytes, raw: float) -> None:
    assert parse_cas(line) == Reading(pytest.approx(raw), rounded=True)  # type: ignore[arg-type]


def test_overload_without_number_is_saturation() -> None:
    reading = parse_cas(b"OL,GS,1\xc4," + 9 * b" " + b"kg")
    assert reading is not None
    assert reading.saturated
    assert math.isnan(reading.raw)


@given(frames(), st.data())
def test_partial_frame_gives_no_reading(frame: tuple[bytes, str, bytes], data: st.DataObject) -> None:
    line = frame[0].removesuffix(b"\r")
    cut = data.draw(st.integers(1, len(line) - 1))
    assert parse_cas(line[:cut]) is None
    assert parse_cas(line[cut:]) is None


@given(st.binary(max_size=200), st.lists(st.integers(0, 200)))
def test_lines_do_not_depend_on_chunks(data: bytes, cuts: list[int]) -> None:
    splitter, lines = LineSplitter(), []
    for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), 200], strict=True):
        lines += splitter.feed(data[begin:end])
    assert lines == data.split(b"\n")[1:-1]


def test_long_data_without_line_feed_is_discarded() -> None:
    splitter = LineSplitter()
    splitter.feed(b"torn\n" + bytes(MAX_LINE_BYTES + 1))
    assert splitter.feed(b"end of it\n12\n") == [b"12"]


def test_a_line_that_is_too_long_is_discarded_if_it_comes_at_once() -> None:
    assert LineSplitter().feed(b"torn\n" + b" " * (MAX_LINE_BYTES + 1) + b"\n12\n") == [b"12"]
