"""Inference on whole recordings frame by frame, with any engine, as in a run."""

from collections.abc import Iterable, Iterator

import numpy as np

from gripper_force.types import Gray
from gripper_force.vision.engines import Engine, Floats, StepOutput
from gripper_force.vision.preprocess import Normaliser, Preprocess


def prepared(frames: Iterable[Gray], preprocess: Preprocess) -> Iterator[Floats]:
    """Yields the network's inputs, (S, S), for the frames of a recording, (S, S) uint8 each."""
    normaliser = Normaliser(preprocess)
    for frame in frames:
        yield from normaliser.push(frame)


def stream(engine: Engine, frames: Iterable[Gray]) -> Iterator[StepOutput]:
    """Yields the networks' output for each frame of a recording, (S, S) uint8 each, as a new stream."""
    engine.reset()
    for frame in prepared(frames, engine.header.preprocess):
        yield engine.step(frame)


def features(engine: Engine, frames: Gray) -> tuple[Floats, Floats]:
    """Estimates the force for every frame of a recording, as `batch_inference.features` does with PyTorch.

    Args:
        engine: The ensemble.
        frames: The recording, cropped and resized, (T, S, S) uint8, with as many frames as the reference or more.

    Returns:
        Each member's forces in N, (M, T), and the members' concatenated features, (T, F).
    """
    steps = list(stream(engine, frames))
    return np.stack([step.forces_n for step in steps], axis=1), np.stack([step.features for step in steps])
