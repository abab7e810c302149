"""Frames to visual estimates, in step with a simulated clock or in a thread beside a real one."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from gripper_force.errors import GripperError
from gripper_force.interfaces import Camera, Clock
from gripper_force.types import NS_PER_MS, Frame, Gray, VisualForce


class Estimator(Protocol):
    """What perception needs of `gripper_force.vision.estimator.ForceEstimator`."""

    def update(self, gray: Gray) -> "ForceEstimate | None":
        """Takes the next frame; None while the reference is being collected."""
        ...


class ForceEstimate(Protocol):
    """A force with its claimed error."""

    @property
    def force_n(self) -> float:
        """Contact force."""
        ...

    @property
    def std_n(self) -> float:
        """Its standard deviation."""
        ...


class ProcessedFrame(NamedTuple):
    """A frame, what the estimator made of it, and what went wrong, if anything did."""

    frame: Frame
    visual: VisualForce | None
    problem: str = ""


class FrameProcessor:
    """Runs the estimator on frames, and survives what it raises.

    An error on the frames before the first estimate means that the run is set up wrongly, and is raised. A
    later one costs the estimate of its frame: the controller goes on with the motor current alone. So does a
    frame that is its forerunner to the bit: sensors have noise, and a camera that hangs has none. Where all
    frames up to the first estimate are the same, as in a recording without noise, it means nothing.
    """

    def __init__(self, estimator: Estimator | None) -> None:
        self._estimator = estimator
        self._works = False
        self._last: Gray | None = None
        self._may_repeat: bool | None = None  # nothing is known yet

    def process(self, frame: Frame, now_ns: Callable[[], int] | None = None) -> ProcessedFrame:
        """Makes an estimate of a frame.

        Args:
            frame: The next frame.
            now_ns: Tells, once it is made, when it was ready; None: when the frame came.

        Raises:
            Exception: What the estimator raised before its first estimate.
        """
        if self._estimator is None:
            return ProcessedFrame(frame, None)
        repeats = self._last is not None and np.array_equal(frame.gray, self._last)
        if self._last is not None and not self._works:
            self._may_repeat = repeats and self._may_repeat is not False
        self._last = frame.gray
        if self._works and repeats and not self._may_repeat:
            return ProcessedFrame(frame, None, "the camera repeats its last picture; see whether it hangs")
        begin_ns = time.perf_counter_ns()
        try:
            result = self._estimator.update(frame.gray)
        except Exception as error:
            if not self._works:
                raise
            own = isinstance(error, GripperError)
            return ProcessedFrame(frame, None, str(error) if own else f"{type(error).__name__}: {error}")
        compute_ms = (time.perf_counter_ns() - begin_ns) / NS_PER_MS
        if result is None:
            return ProcessedFrame(frame, None)
        self._works = True
        ready_ns = frame.received_ns if now_ns is None else now_ns()
        visual = VisualForce(frame.t_ns, ready_ns, frame.seq, result.force_n, result.std_n, compute_ms)
        return ProcessedFrame(frame, visual)


class Perception(Protocol):
    """Eyes of a session."""

    def start(self) -> None:
        """Begins to look."""
        ...

    def poll(self) -> list[ProcessedFrame]:
        """What has become ready since the last call, oldest first."""
        ...

    def close(self) -> None:
        """Stops looking. May be called twice."""
        ...


class LockstepPerception:
    """Estimates in the caller's thread; an estimate is there a fixed simulated time after its frame."""

    def __init__(
        self, camera: Camera | None, estimator: Estimator | None, clock: Clock, compute_ms: float
    ) -> None:
        self._camera, self._processor, self._clock = camera, FrameProcessor(estimator), clock
        self._compute_ns = round(compute_ms * NS_PER_MS) if estimator is not None else 0
        self._under_way: deque[tuple[int, ProcessedFrame]] = deque()

    def start(self) -> None:
        """Nothing to start."""

    def poll(self) -> list[ProcessedFrame]:
        """What has become ready since the last call, oldest first."""
        now_ns = self._clock.now_ns()
        busy = self._under_way and self._under_way[-1][0] > now_ns
        if not busy and self._camera is not None and (frame := self._camera.newest()) is not None:
            ready_ns = now_ns + self._compute_ns
            self._under_way.append((ready_ns, self._processor.process(frame, lambda: ready_ns)))
        ready = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            ready.append(self._under_way.popleft()[1])
        return ready

    def close(self) -> None:
        """Nothing to stop."""


class ThreadedPerception:
    """Estimates in a thread of its own, always on the newest frame."""

    _IDLE_S = 0.001
    _PATIENCE_S = 1.0

    def __init__(self, camera: Camera | None, estimator: Estimator | None, clock: Clock) -> None:
        self._camera, self._processor, self._clock = camera, FrameProcessor(estimator), clock
        self._done: deque[ProcessedFrame] = deque()
        self._failure: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="perception", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        if self._camera is not None:
            self._thread.start()

    def poll(self) -> list[ProcessedFrame]:
        """What has become ready since the last call, oldest first. Raises what stopped the thread."""
        if self._failure is not None:
            raise self._failure
        return [self._done.popleft() for _ in range(len(self._done))]

    def close(self) -> None:
        """Stops the thread, or leaves it behind where a model hangs. May be called twice."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(self._PATIENCE_S)

    def _run(self) -> None:
        assert self._camera is not None
        try:
            while not self._stop.is_set():
                frame = self._camera.newest()
                if frame is None:
                    self._stop.wait(self._IDLE_S)
                    continue
                self._done.append(self._processor.process(frame, self._clock.now_ns))
        except Exception as error:  # it is the control thread's to raise
            self._failure = error
