"""Fuzz targets of the load cells: serial lines and sample validation."""

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from gripper_force.qualification.fuzz.target import Target
from gripper_force.types import NS_PER_MS
from gripper_hw.load_cells.line_formats import MAX_LINE_BYTES, PARSERS, LineSplitter, Reading
from gripper_hw.load_cells.screening import SampleValidator

_PIECE: Final = 100
"""Bytes that arrive at once."""

_SAMPLE: Final = struct.Struct("<dq")


def _counts() -> list[bytes]:
    lines = [f"{8_388_607 * (i == 7) + 1000 * i % 7919}" for i in range(24)]
    return [
        "\r\n".join(lines).encode(),
        "\n".join(f"{12_500 * i},{line}" for i, line in enumerate(lines)).encode(),
    ]


def _frames() -> list[bytes]:
    long = b"".join(b"ST,GS,\x01\x88,%8.3f kg\r\n" % (0.013 * i) for i in range(12))
    return [long, long.replace(b"ST", b"OL"), b"US,NT,-  0.125 g\r\n" * 8, b"   0.125\r\n" * 9]


def _read_lines(parse: Callable[[bytes], Reading | None], data: bytes, _path: Path) -> None:
    splitter, validator = LineSplitter(), SampleValidator(100.0, -1e-3)
    for t_ns, at in enumerate(range(0, len(data), _PIECE)):
        for line in splitter.feed(data[at : at + _PIECE]):
            if (reading := parse(line)) is not None:
                validator.add(t_ns * NS_PER_MS, *reading)
        validator.take(t_ns * NS_PER_MS)
    assert len(splitter._partial) <= MAX_LINE_BYTES + _PIECE


def _readings() -> list[bytes]:
    return [b"".join(_SAMPLE.pack(0.01 * i % 3, 12 * NS_PER_MS * i) for i in range(40))]


def _validate(data: bytes, _path: Path) -> None:
    validator = SampleValidator(0.5, 2.0)
    taken = 0
    complete = data[: len(data) // _SAMPLE.size * _SAMPLE.size]
    for raw, t_ns in _SAMPLE.iter_unpack(complete):
        validator.add(t_ns, raw)
        taken += len(validator.take(t_ns)) if t_ns & 3 == 0 else 0
    assert taken <= len(complete) // _SAMPLE.size


TARGETS: Final = [
    Target(
        "lines of hx711", _counts, partial(_read_lines, PARSERS["hx711"]), 20, (b"+", b"8388608", b"-8388608")
    ),
    Target("lines of cas", _frames, partial(_read_lines, PARSERS["cas"]), 20, (b"OL,", b"kg", b" g", b".")),
    Target("readings", _readings, _validate, 4),
]
