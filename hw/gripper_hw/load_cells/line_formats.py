"""Parsers of the lines that load cells send on a serial port. They accept any bytes and never raise."""

import math
import re
from collections.abc import Callable
from typing import Final, NamedTuple

MAX_LINE_BYTES: Final = 256
"""Longest line in bytes; longer ones are discarded."""

HX711_MIN: Final = -0x800000
HX711_MAX: Final = 0x7FFFFF
"""Limits of the 24-bit converter; it gives one of these two if its input is out of range."""

_HX711: Final = re.compile(
    rb"\s*(?:\d+,|[A-Za-z][^:=|]*[:=]|[A-Za-z][A-Za-z_ ]*\s)?"
    rb"\s*([+-]?\d{1,8})(\.\d*)?\s*(?:([A-Za-z]{1,3})|,([A-Za-z]{2,3})(?:,.*)?)?\s*(?:\|.*)?"
)
_CAS: Final = re.compile(rb"(?:(ST|US|OL),(?:GS|NT),(?:..,)?)?(.{8})(?: ?(kg|g | g))?", re.DOTALL)
_CAS_LENGTHS: Final = frozenset({8, 16, 20})
_DECIMAL: Final = re.compile(rb" *([+-]?) *(\d+\.?\d*|\.\d+) *")
_KG: Final = {b"kg": 1.0, b"g": 1e-3}


class Reading(NamedTuple):
    """One reading of a load cell.

    Attributes:
        raw: The reading in the sensor's unit; NaN if the line has no number.
        saturated: True if the sensor reports that it is beyond its range.
        rounded: True if the reading is rounded, so that it may stay the same at rest. Counts of a converter
            always vary.
    """

    raw: float
    saturated: bool = False
    rounded: bool = False


def parse_hx711(line: bytes) -> Reading | None:
    """Parses a line of a board with an HX711 converter.

    It is ``<raw>`` or ``<micros>,<raw>`` in counts, or a value that the board has scaled, such as ``12.34``,
    with or without a name before it and a unit behind it: ``HX711 reading: 8421``, ``Weight: 12 g``. What
    follows a bar is not used: ``one reading: -0.4 | average: -0.2``. Nor is what follows the unit in a line of
    SparkFun's OpenScale (https://github.com/sparkfun/OpenScale): ``<millis>,12.34,kg,24.50,``. The unit is not
    converted: `load_cell.n_per_raw` is newtons per unit of the value. See
    https://cdn.sparkfun.com/datasheets/Sensors/ForceFlex/hx711_english.pdf for the counts.

    Returns:
        The reading, or None if the line is not valid.
    """
    match = _HX711.fullmatch(line)
    if match is None:
        return None
    if any(group is not None for group in match.groups()[1:]):
        return Reading(float(match[1] + (match[2] or b"")), rounded=True)
    if not HX711_MIN <= (raw := int(match[1])) <= HX711_MAX:
        return None
    return Reading(float(raw), saturated=raw in (HX711_MIN, HX711_MAX))


def parse_cas(line: bytes) -> Reading | None:
    """Parses a weighing indicator's frame without its line feed; the reading is in kg.

    With CR and LF a frame has 22 bytes (``ST,GS,<id><lamp>,<8 bytes> kg``), 18 (``ST,GS,<8 bytes>kg``) or 10
    (only the 8 bytes, taken as kg). The lamp byte is not ASCII: its bit 7 is set. See the appendix "Data
    format" of the CAS CI-400's manual: https://www.easymanua.ls/cas/ci-400-series/manual?p=103

    Returns:
        The reading, or None if the line is not valid.
    """
    match = _CAS.fullmatch(line.removesuffix(b"\r"))
    if match is None or len(match[0]) not in _CAS_LENGTHS:
        return None
    state, data, unit = match.groups()
    number = _DECIMAL.fullmatch(data)
    if number is None:
        return Reading(math.nan, saturated=True, rounded=True) if state == b"OL" else None
    raw = float(number[1] + number[2]) * _KG[unit.strip() if unit else b"kg"]
    return Reading(raw, saturated=state == b"OL", rounded=True)


PARSERS: Final[dict[str, Callable[[bytes], Reading | None]]] = {"hx711": parse_hx711, "cas": parse_cas}
"""Parser for each value of ``load_cell.format``."""


class LineSplitter:
    """Splits received bytes into lines. Discards the first: it may have begun before the port was opened."""

    def __init__(self) -> None:
        self._partial = bytearray()
        self._discard_next = True

    def feed(self, data: bytes) -> list[bytes]:
        """Returns the lines that ``data`` completes, without the line feeds."""
        *lines, rest = (self._partial + data).split(b"\n")
        if self._discard_next and lines:
            del lines[0]
            self._discard_next = False
        if len(rest) > MAX_LINE_BYTES:
            rest = bytearray()
            self._discard_next = True
        self._partial = bytearray(rest)
        return [bytes(line) for line in lines if len(line) <= MAX_LINE_BYTES]
