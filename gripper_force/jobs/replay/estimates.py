"""Visual estimates of a log's frames, one frame at a time or in batches."""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from gripper_force.errors import GripperError, UnfamiliarFrameError
from gripper_force.runtime.perception import FrameProcessor
from gripper_force.runtime.process import allowed_options
from gripper_force.runtime.resolve import ResolvedConfig, make_estimator
from gripper_force.types import ForceEstimate, Frame, Gray, Record, VisualForce

if TYPE_CHECKING:  # a log without vision needs no estimator
    from gripper_force.vision.engines import Floats
    from gripper_force.vision.estimator import ForceEstimator


_UNKNOWN: Final = ForceEstimate(math.nan, math.nan)

_NO_IMAGE: Final = np.zeros((0, 0), np.uint8)

_NOTHING: Final = np.zeros((0, 0), np.float32)


def estimates_by_frame(
    records: Iterable[Record], resolved: ResolvedConfig
) -> Iterator[tuple[Record, VisualForce | None]]:
    """Yields each record, with the estimate of a frame, as a run computes it."""
    processor = FrameProcessor(make_estimator(resolved))
    for record in records:
        yield record, processor.process(record).visual if isinstance(record, Frame) else None


def estimates_in_batches(
    records: Iterable[Record], resolved: ResolvedConfig
) -> Iterator[tuple[Record, VisualForce | None]]:
    """Yields each record, with the estimate of a frame, computed many frames at a time. The frames have no image."""
    import torch

    from gripper_force.vision.batch_inference import kept_checkpoint, prepared_features
    from gripper_force.vision.engines import StepOutput
    from gripper_force.vision.engines.pytorch import TorchEngine, restored_threads
    from gripper_force.vision.estimator import ForceEstimator

    assert resolved.model is not None
    vision, checkpoint = resolved.config.vision, kept_checkpoint(resolved.model.path, resolved.model.digest)
    engine = TorchEngine(checkpoint, threads=vision.threads if allowed_options().torch_threads else None)
    estimator = ForceEstimator(engine, vision.region, resolved.correction, vision.max_covered)
    waiting: deque[_Waiting] = deque()
    chunks = prepared_features(checkpoint.networks, _batches(records, estimator, waiting))
    works, done = False, 0
    while True:
        with restored_threads():
            torch.set_num_threads(1)  # the last digits depend on their number
            forces_n, features = next(chunks, (_NOTHING, _NOTHING))  # (M, K), (K, F)
        while waiting and waiting[0].inputs <= done + len(features):
            record, visual, inputs = waiting.popleft()
            if visual is not None and visual.is_familiar:  # the network has not run on covered frames
                last = inputs - 1 - done
                try:
                    estimate = estimator.finish(StepOutput(forces_n[:, last], features[last], None))
                except GripperError as error:  # as in `FrameProcessor`
                    if not works:
                        raise
                    visual = (
                        replace(visual, force_n=error.force_n, std_n=math.inf)
                        if isinstance(error, UnfamiliarFrameError)
                        else None
                    )
                else:
                    visual = replace(visual, force_n=estimate.force_n, std_n=estimate.std_n)
                works = True
            yield record, visual
        if not len(features):
            return
        done += len(features)


class _Waiting(NamedTuple):
    """A record that waits for the networks.

    Attributes:
        record: The record.
        visual: Its estimate, still without a force; None for other records than frames, and for frames without one.
        inputs: Number of the networks' inputs up to this record.
    """

    record: Record
    visual: VisualForce | None
    inputs: int


def _batches(
    records: Iterable[Record], estimator: "ForceEstimator", waiting: deque[_Waiting]
) -> "Iterator[Floats]":
    """Yields the networks' inputs, (N, S, S), made of the frames among the records; adds all records to ``waiting``."""
    from gripper_force.vision.batch_inference import BATCH

    preparation = _Preparation(estimator)
    processor = FrameProcessor(preparation)
    inputs, count = preparation.inputs, 0
    for record in records:
        visual, before = None, len(inputs)
        if isinstance(record, Frame):
            visual = processor.process(record).visual
            record = replace(record, gray=_NO_IMAGE)
        count += len(inputs) - before
        waiting.append(_Waiting(record, visual, count))
        while len(inputs) >= BATCH["cpu"]:
            yield np.stack(inputs[: BATCH["cpu"]])
            del inputs[: BATCH["cpu"]]
    if inputs:
        yield np.stack(inputs)


class _Preparation:
    """Takes the place of an estimator in `FrameProcessor`, and only prepares the frames for the networks."""

    def __init__(self, estimator: "ForceEstimator") -> None:
        self._estimator = estimator
        self.inputs: list[Floats] = []

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Prepares the next frame; returns None while the reference is being collected."""
        ready = self._estimator.prepare(gray)
        self.inputs += ready
        return _UNKNOWN if ready else None

    def attention_map(self) -> None:
        """Returns None: nothing was computed yet."""
