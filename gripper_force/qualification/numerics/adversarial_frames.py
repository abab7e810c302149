"""Numerically hard recordings."""

from collections.abc import Callable
from typing import Final

import numpy as np

from gripper_force.types import Gray

REFERENCE: Final = 4
"""Frames at the start that stay unchanged, for the reference frame."""


def disturbed(clip: Gray, seed: int) -> dict[str, list[Gray]]:
    """Returns variants of a recording, each with one disturbance after its reference frames.

    Args:
        clip: Frames, (T, H, W), uint8.
        seed: Seed of the random disturbances.
    """
    rng = np.random.default_rng([seed, 50])
    start, rest = list(clip[:REFERENCE]), list(clip[REFERENCE:])

    def some(change: Callable[[Gray], Gray], every: int = 5) -> list[Gray]:
        return start + [change(frame) if i % every == 0 else frame for i, frame in enumerate(rest)]

    def brightened(factor: float) -> Callable[[Gray], Gray]:
        return lambda frame: (frame * factor).clip(0, 255).astype(np.uint8)

    def hot(frame: Gray) -> Gray:
        changed = frame.copy()
        changed[5, 7] = 255
        return changed

    def filled(level: int) -> Callable[[Gray], Gray]:
        return lambda frame: np.full_like(frame, level)

    strong = [brightened(2.0 if i % 2 else 0.5)(frame) for i, frame in enumerate(rest)]
    mild = [brightened(1.25 if i % 2 else 0.8)(frame) for i, frame in enumerate(rest)]
    return {
        "undisturbed grasp": start + rest,
        "black frames": some(filled(0)),
        "white frames": some(filled(255)),
        "gray frames": some(filled(128)),
        "flat frame with a pixel at 255": some(lambda frame: hot(filled(100)(frame))),
        "pixel stuck at 255": some(hot, every=1),
        "noise": some(lambda frame: rng.integers(0, 256, frame.shape, np.uint8)),
        "frames of NaN": some(lambda frame: np.full(frame.shape, np.nan)),
        "exposure alternating x 0.5 and x 2": start + strong,
        "exposure alternating x 0.8 and x 1.25": start + mild,
        "one-frame flashes, x 1.5": some(brightened(1.5)),
        "one-frame flashes, x 4": some(brightened(4.0)),
        "two of three frames lost": start + rest[::3],
        "half of the frames lost at random": start + [frame for frame in rest if rng.random() < 0.5],
        "every frame repeated three times": start + [frame for frame in rest for _ in range(3)],
    }
