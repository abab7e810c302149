"""Recordings that are hard on numbers."""

from collections.abc import Callable
from typing import Final

import numpy as np

from gripper_force.types import Gray

REFERENCE: Final = 4
"""Frames at the start that are left as they are, for the reference."""


def spoiled(clip: Gray, seed: int) -> dict[str, list[Gray]]:
    """The recording with something wrong after its reference frames."""
    rng = np.random.default_rng([seed, 50])
    start, rest = list(clip[:REFERENCE]), list(clip[REFERENCE:])

    def some(change: Callable[[Gray], Gray], every: int = 5) -> list[Gray]:
        return start + [change(frame) if i % every == 0 else frame for i, frame in enumerate(rest)]

    def gain(factor: float) -> Callable[[Gray], Gray]:
        return lambda frame: (frame * factor).clip(0, 255).astype(np.uint8)

    def hot(frame: Gray) -> Gray:
        seen = frame.copy()
        seen[5, 7] = 255
        return seen

    def filled(level: int) -> Callable[[Gray], Gray]:
        return lambda frame: np.full_like(frame, level)

    turns = [gain(2.0 if i % 2 else 0.5)(frame) for i, frame in enumerate(rest)]
    mild = [gain(1.25 if i % 2 else 0.8)(frame) for i, frame in enumerate(rest)]
    return {
        "a grasp": start + rest,
        "black frames": some(filled(0)),
        "white frames": some(filled(255)),
        "gray frames": some(filled(128)),
        "a pixel at 255 in a flat frame": some(lambda frame: hot(filled(100)(frame))),
        "a pixel that stays at 255": some(hot, every=1),
        "noise": some(lambda frame: rng.integers(0, 256, frame.shape, np.uint8)),
        "frames of NaN": some(lambda frame: np.full(frame.shape, np.nan)),
        "exposure x 0.5 and x 2 in turns": start + turns,
        "exposure x 0.8 and x 1.25 in turns": start + mild,
        "flashes of one frame, x 1.5": some(gain(1.5)),
        "flashes of one frame, to white": some(gain(4.0)),
        "two of three frames lost": start + rest[::3],
        "frames lost and late at random": start + [frame for frame in rest if rng.random() < 0.5],
        "every frame three times": start + [frame for frame in rest for _ in range(3)],
    }
