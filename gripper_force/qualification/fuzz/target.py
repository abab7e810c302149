"""Description of a reader that the fuzzer feeds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Target:
    """One reader of input.

    Attributes:
        name: Name in reports and in ``--only``.
        examples: Returns valid inputs to damage, the same in every process.
        feed: Reads an input. The path is a scratch file for readers of files.
        weight: Share of the inputs, relative to other targets.
        words: Byte strings with a meaning in this format.
        repair: Makes a damaged input pass its checksums; applied to half of the inputs.
    """

    name: str
    examples: Callable[[], Sequence[bytes]]
    feed: Callable[[bytes, Path], object]
    weight: float = 1.0
    words: tuple[bytes, ...] = ()
    repair: Callable[[bytes], bytes] | None = None
