"""The simulated camera, load cell and clock with their faults (see `gripper_force.fault_config.FAULTS`)."""

import math
import time
from collections import deque
from dataclasses import replace
from unittest import mock

import numpy as np

from gripper_force.interfaces import Camera, Clock, LoadCell
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, LoadCellSample
from gripper_hw.fault_injection import Faults
from gripper_hw.load_cells.screening import SampleValidator
from gripper_hw.sim.simulated_rig import GAMMA

# The values of the fault kinds of `FAULTS`, in the order of its units: camera, load cell, clock.
_SLOW_FRAME_PERIOD_NS = NS_PER_S // 5
_FRAME_DELAY_NS = 300 * NS_PER_MS
_LOST_FRAMES_SHARE = 0.8
_LIGHT_FACTOR = 6.0
_SLOW_SAMPLE_PERIOD_NS = NS_PER_S // 2
_SAMPLE_DELAY_NS = 500 * NS_PER_MS
_GAP_NS = 300 * NS_PER_MS
_FULL_SCALE_N = 200.0

_CYCLE_DELAY_NS = 15 * NS_PER_MS
_DAY_S = 86_400.0


class FaultyCamera:
    """A camera with faults: frames are lost, delayed, repeated or corrupted."""

    def __init__(self, camera: Camera, faults: Faults, clock: Clock, seed: int) -> None:
        self._camera, self._faults, self._clock = camera, faults, clock
        self._rng = np.random.default_rng([seed, 4])
        self._delayed: deque[Frame] = deque()
        self._last: Frame | None = None
        self._next_ns = 0

    def start(self) -> None:
        """Starts capturing."""
        self._camera.start()

    def newest(self) -> Frame | None:
        """Returns the newest frame, changed by the active fault, or None."""
        now_ns, frame = self._clock.now_ns(), self._camera.newest()
        kind = self._faults.active("camera", now_ns)
        if kind == "delayed":
            return self._delay(frame, now_ns)
        self._delayed.clear()
        if frame is None or kind == "off":
            return None
        match kind:
            case "stuck" if self._last is not None:
                return replace(frame, gray=self._last.gray)
            case "garbage":
                noise = self._rng.integers(0, 256, frame.gray.shape, np.uint8)
                return replace(frame, gray=noise)
            case "wrong":
                bright = 255 * np.minimum(_LIGHT_FACTOR * (frame.gray / 255) ** GAMMA, 1) ** (1 / GAMMA)
                return replace(frame, gray=bright.astype(np.uint8))
            case "slow":
                if now_ns < self._next_ns:
                    return None
                self._next_ns = now_ns + _SLOW_FRAME_PERIOD_NS
            case "intermittent" if self._rng.random() < _LOST_FRAMES_SHARE:
                return None
        self._last = frame
        return frame

    def counts(self) -> dict[str, int]:
        """Counters of the wrapped camera."""
        return self._camera.counts()

    def close(self) -> None:
        """Stops capturing. May be called twice."""
        self._camera.close()

    def _delay(self, frame: Frame | None, now_ns: int) -> Frame | None:
        if frame is not None:
            self._delayed.append(replace(frame, received_ns=frame.received_ns + _FRAME_DELAY_NS))
        newest = None
        while self._delayed and self._delayed[0].received_ns <= now_ns:
            newest = self._delayed.popleft()
        return newest


class FaultyLoadCell:
    """A load cell with faults. Its samples are validated like those of real load cells."""

    def __init__(self, cell: LoadCell, faults: Faults, clock: Clock, seed: int) -> None:
        self._cell, self._faults, self._clock = cell, faults, clock
        self._rng = np.random.default_rng([seed, 5])
        self._validator = SampleValidator(0.0, 1.0)
        self._delayed: deque[LoadCellSample] = deque()
        self._last_n = 0.0
        self._next_ns = 0

    def start(self) -> None:
        """Starts sampling."""
        self._cell.start()

    def drain(self) -> list[LoadCellSample]:
        """Returns the samples since the last call that can be checked by now, oldest first."""
        now_ns = self._clock.now_ns()
        self._delayed.extend(replace(s, t_ns=s.t_ns + _SAMPLE_DELAY_NS) for s in self._cell.drain())
        while self._delayed:
            sampled_ns = self._delayed[0].t_ns - _SAMPLE_DELAY_NS
            kind = self._faults.active("load_cell", sampled_ns)
            if kind == "delayed" and self._delayed[0].t_ns > now_ns:
                break
            sample = self._delayed.popleft()
            self._add(kind, sample.t_ns if kind == "delayed" else sampled_ns, sample.raw)
        return self._validator.take(now_ns)

    def counts(self) -> dict[str, int]:
        """Number of rejected samples, by cause."""
        return self._validator.counts()

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        self._cell.close()

    def _add(self, kind: str, t_ns: int, raw: float) -> None:
        if t_ns < self._next_ns:  # after a delay, samples older than the last one are lost
            return
        self._next_ns = t_ns + (_SLOW_SAMPLE_PERIOD_NS if kind == "slow" else 1)
        match kind:
            case "off":
                return
            case "stuck":
                raw = self._last_n
            case "garbage":
                raw = float(
                    self._rng.choice([math.nan, math.inf, self._rng.uniform(-_FULL_SCALE_N, _FULL_SCALE_N)])
                )
            case "intermittent" if t_ns // _GAP_NS % 2:
                return
        self._last_n = raw
        if kind == "wrong":
            raw = _FULL_SCALE_N
        self._validator.add(t_ns, raw, saturated=raw >= _FULL_SCALE_N)


class FaultyClock:
    """A clock with faults: it sleeps too long, or the host's wall clock (which no code may use) jumps."""

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock, self._faults = clock, faults
        self._time_patch = mock.patch("time.time", self._wrong_time)
        self._real_time = time.time
        self._patched = False

    def now_ns(self) -> int:
        """Monotonic time."""
        return self._clock.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Returns at ``t_ns``, or later because of the active fault."""
        kind = self._faults.active("clock", t_ns)
        if (kind == "wrong") != self._patched:
            self.close()
            if kind == "wrong":
                self._time_patch.start()
                self._patched = True
        if kind == "stuck":
            t_ns = self._faults.end_ns("clock", t_ns)
        elif kind == "slow":
            t_ns += _CYCLE_DELAY_NS
        self._clock.sleep_until_ns(t_ns)

    def close(self) -> None:
        """Restores the wall clock. May be called twice."""
        if self._patched:
            self._time_patch.stop()
            self._patched = False

    def _wrong_time(self) -> float:
        return self._real_time() - _DAY_S
