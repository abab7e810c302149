"""Perception: camera frames to visual estimates, in lockstep or in a thread of its own."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gripper_force.errors import GripperError, UnfamiliarFrameError
from gripper_force.interfaces import Camera, Clock
from gripper_force.types import NS_PER_MS, AttentionMap, ForceEstimate, Frame, Gray, VisualForce


class Estimator(Protocol):
    """Part of `gripper_force.vision.estimator.ForceEstimator` that perception uses."""

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Takes the next frame; returns None while the reference is being collected."""

    def renew_reference(self) -> None:
        """Takes the last frames as the reference of the next ones."""

    def attention_map(self) -> npt.NDArray[np.float32] | None:
        """Returns the attention over the newest frame, (h, w) in 0..1, or None."""


class ProcessedFrame(NamedTuple):
    """A frame, its estimate and attention (None without one), and the problem (empty without one)."""

    frame: Frame
    visual: VisualForce | None
    problem: str = ""
    attention: AttentionMap | None = None


class FrameProcessor:
    """Runs the estimator on frames, and contains its errors.

    An error before the first estimate means that the run is set up wrongly; it is raised. A later error, or an object
    or view that the network does not know, only costs the estimate of its frame: the controller continues on motor
    current. An unfamiliar frame keeps the network's output, with an infinite claimed error; of a covered view it is
    NaN. A frame that equals the previous one bit for bit gives no estimate, because sensors have noise and a camera
    that hangs has none. If all frames up to the first estimate are equal, as in a recording without noise, repeats are
    accepted.

    Attributes:
        renewal_ns: Time to set if the last frames up to it are to become the reference of those after it. They must
            show no contact.
    """

    def __init__(self, estimator: Estimator | None) -> None:
        self._estimator = estimator
        self._has_estimated = False
        self._last_gray: Gray | None = None
        self._may_repeat: bool | None = None  # unknown
        self.renewal_ns: int | None = None

    def process(self, frame: Frame, now_ns: Callable[[], int] | None = None) -> ProcessedFrame:
        """Estimates the force in a frame.

        Args:
            frame: The next frame.
            now_ns: Returns the time at which the estimate is ready; None: the time the frame was received.

        Raises:
            Exception: The estimator failed before its first estimate.
        """
        if self._estimator is None:
            return ProcessedFrame(frame, None)
        is_repeat = self._last_gray is not None and np.array_equal(frame.gray, self._last_gray)
        if self._last_gray is not None and not self._has_estimated:
            self._may_repeat = is_repeat and self._may_repeat is not False
        self._last_gray = frame.gray
        if self._has_estimated and is_repeat and not self._may_repeat:
            return ProcessedFrame(frame, None, "the camera repeats its last image; check whether it hangs")
        begin_ns, problem = time.perf_counter_ns(), ""
        try:
            if self.renewal_ns is not None and frame.t_ns > self.renewal_ns:
                self.renewal_ns = None
                self._estimator.renew_reference()
            result = self._estimator.update(frame.gray)
        except Exception as error:
            has_output = isinstance(error, UnfamiliarFrameError) and math.isfinite(error.force_n)
            if not (self._has_estimated or has_output):
                raise
            problem = str(error) if isinstance(error, GripperError) else f"{type(error).__name__}: {error}"
            if not isinstance(error, UnfamiliarFrameError):
                return ProcessedFrame(frame, None, problem)
            result = ForceEstimate(error.force_n, math.inf)
        compute_ms = (time.perf_counter_ns() - begin_ns) / NS_PER_MS
        if result is None:
            return ProcessedFrame(frame, None)
        self._has_estimated = True
        ready_ns = frame.received_ns if now_ns is None else now_ns()
        visual = VisualForce(frame.t_ns, ready_ns, frame.seq, result.force_n, result.std_n, compute_ms)
        # The network has not run on a covered view.
        attention = None if math.isnan(result.force_n) else _attention(frame, ready_ns, self._estimator)
        return ProcessedFrame(frame, visual, problem, attention)


def _attention(frame: Frame, ready_ns: int, estimator: Estimator) -> AttentionMap | None:
    if (attention := estimator.attention_map()) is None:
        return None
    scaled = (attention - attention.min()) / max(float(np.ptp(attention)), 1e-6)
    return AttentionMap(frame.t_ns, ready_ns, frame.seq, np.rint(255 * scaled).astype(np.uint8))


class LockstepPerception:
    """Processes frames in the caller's thread; estimates are ready after a fixed simulated time.

    Attributes:
        processor: Makes the estimates.
    """

    def __init__(
        self, camera: Camera | None, estimator: Estimator | None, clock: Clock, compute_ms: float
    ) -> None:
        self._camera, self.processor, self._clock = camera, FrameProcessor(estimator), clock
        self._compute_ns = round(compute_ms * NS_PER_MS) if estimator is not None else 0
        self._under_way: deque[tuple[int, ProcessedFrame]] = deque()

    def start(self) -> None:
        """Has no effect: there is no thread."""

    def poll(self) -> list[ProcessedFrame]:
        """Returns the frames that became ready since the last call, oldest first."""
        now_ns = self._clock.now_ns()
        is_busy = self._under_way and self._under_way[-1][0] > now_ns
        if not is_busy and self._camera is not None and (frame := self._camera.newest()) is not None:
            ready_ns = now_ns + self._compute_ns
            self._under_way.append((ready_ns, self.processor.process(frame, lambda: ready_ns)))
        ready_frames = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            ready_frames.append(self._under_way.popleft()[1])
        return ready_frames

    def close(self) -> None:
        """Has no effect: there is no thread."""


class ThreadedPerception:
    """Processes the newest frame in a background thread.

    Attributes:
        processor: Makes the estimates.
    """

    _IDLE_S = 0.001
    _PATIENCE_S = 1.0

    def __init__(self, camera: Camera | None, estimator: Estimator | None, clock: Clock) -> None:
        self._camera, self.processor, self._clock = camera, FrameProcessor(estimator), clock
        self._processed: deque[ProcessedFrame] = deque()
        self._failure: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="perception", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        if self._camera is not None:
            self._thread.start()

    def poll(self) -> list[ProcessedFrame]:
        """Returns the frames that became ready since the last call; re-raises an exception of the thread."""
        if self._failure is not None:
            raise self._failure
        return [self._processed.popleft() for _ in range(len(self._processed))]

    def close(self) -> None:
        """Stops the thread; gives up after 1 s if the estimator hangs. May be called twice."""
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
                self._processed.append(self.processor.process(frame, self._clock.now_ns))
        except Exception as error:  # re-raised in the control thread
            self._failure = error


Perception = LockstepPerception | ThreadedPerception
"""Source of processed frames for a session."""
