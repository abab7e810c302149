"""The simulated camera, load cell and clock with their faults (see `gripper_force.fault_config.FAULTS`)."""

import math
import time
from collections import deque
from dataclasses import replace
from unittest import mock

import numpy as np

from gripper_force.fault_injection import Faults
from gripper_force.interfaces import Camera, Clock, LoadCell
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, LoadCellSample
from gripper_hw.load_cells.screening import Screen

_SLOW_FRAME_NS = NS_PER_S // 5
_LATE_FRAME_NS = 300 * NS_PER_MS
_LOST_FRAMES = 0.8
_LIGHT = 6.0
_GAMMA = 2.2

_SLOW_SAMPLE_NS = NS_PER_S // 2
_LATE_SAMPLE_NS = 500 * NS_PER_MS
_GAP_NS = 300 * NS_PER_MS
_FULL_SCALE_N = 200.0

_SLOW_CYCLE_NS = 15 * NS_PER_MS
_DAY_S = 86_400.0


class FaultyCamera:
    """A camera whose frames are lost, late, repeated or spoiled."""

    def __init__(self, camera: Camera, faults: Faults, clock: Clock, seed: int) -> None:
        self._camera, self._faults, self._clock = camera, faults, clock
        self._rng = np.random.default_rng([seed, 4])
        self._late: deque[Frame] = deque()
        self._last: Frame | None = None
        self._next_ns = 0

    def start(self) -> None:
        """Begins to capture."""
        self._camera.start()

    def newest(self) -> Frame | None:
        """The newest frame, as the fault lets it through."""
        now_ns, frame = self._clock.now_ns(), self._camera.newest()
        kind = self._faults.active("camera", now_ns)
        if kind == "delayed":
            return self._delay(frame, now_ns)
        self._late.clear()
        if frame is None or kind == "off":
            return None
        match kind:
            case "stuck" if self._last is not None:
                return replace(frame, gray=self._last.gray)
            case "garbage":
                noise = self._rng.integers(0, 256, frame.gray.shape, np.uint8)
                return replace(frame, gray=noise)
            case "wrong":
                bright = 255 * np.minimum(_LIGHT * (frame.gray / 255) ** _GAMMA, 1) ** (1 / _GAMMA)
                return replace(frame, gray=bright.astype(np.uint8))
            case "slow":
                if now_ns < self._next_ns:
                    return None
                self._next_ns = now_ns + _SLOW_FRAME_NS
            case "intermittent" if self._rng.random() < _LOST_FRAMES:
                return None
        self._last = frame
        return frame

    def counts(self) -> dict[str, int]:
        """What the camera within counts."""
        return self._camera.counts()

    def close(self) -> None:
        """Stops capturing. May be called twice."""
        self._camera.close()

    def _delay(self, frame: Frame | None, now_ns: int) -> Frame | None:
        if frame is not None:
            self._late.append(replace(frame, received_ns=frame.received_ns + _LATE_FRAME_NS))
        newest = None
        while self._late and self._late[0].received_ns <= now_ns:
            newest = self._late.popleft()
        return newest


class FaultyLoadCell:
    """A load cell that fails, behind the screen that real ones have."""

    def __init__(self, cell: LoadCell, faults: Faults, clock: Clock, seed: int) -> None:
        self._cell, self._faults, self._clock = cell, faults, clock
        self._rng = np.random.default_rng([seed, 5])
        self._screen = Screen(0.0, 1.0, noisy=True)
        self._late: deque[LoadCellSample] = deque()
        self._last_n = 0.0
        self._next_ns = 0

    def start(self) -> None:
        """Begins to sample."""
        self._cell.start()

    def drain(self) -> list[LoadCellSample]:
        """The samples since the last call that can be judged by now."""
        now_ns = self._clock.now_ns()
        self._late.extend(replace(s, t_ns=s.t_ns + _LATE_SAMPLE_NS) for s in self._cell.drain())
        while self._late:
            on_time_ns = self._late[0].t_ns - _LATE_SAMPLE_NS
            kind = self._faults.active("load_cell", on_time_ns)
            if kind == "delayed" and self._late[0].t_ns > now_ns:
                break
            sample = self._late.popleft()
            self._read(kind, sample.t_ns if kind == "delayed" else on_time_ns, sample.raw)
        return self._screen.take(now_ns)

    def counts(self) -> dict[str, int]:
        """What the screen rejects: cause to how often."""
        return self._screen.counts()

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        self._cell.close()

    def _read(self, kind: str, t_ns: int, raw: float) -> None:
        match kind:
            case "off":
                return
            case "stuck":
                raw = self._last_n
            case "garbage":
                raw = float(
                    self._rng.choice([math.nan, math.inf, self._rng.uniform(-_FULL_SCALE_N, _FULL_SCALE_N)])
                )
            case "slow":
                if t_ns < self._next_ns:
                    return
                self._next_ns = t_ns + _SLOW_SAMPLE_NS
            case "intermittent" if t_ns // _GAP_NS % 2:
                return
        self._last_n = raw
        if kind == "wrong":
            raw = _FULL_SCALE_N
        self._screen.add(t_ns, raw, saturated=raw >= _FULL_SCALE_N)


class FaultyClock:
    """A clock that oversleeps, or a host whose wall clock jumps, which nothing here may go by."""

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock, self._faults = clock, faults
        self._jump = mock.patch("time.time", self._wrong_time)
        self._right_time = time.time
        self._jumped = False

    def now_ns(self) -> int:
        """Monotonic time."""
        return self._clock.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Returns at ``t_ns``, or when the fault lets it."""
        kind = self._faults.active("clock", t_ns)
        if (kind == "wrong") != self._jumped:
            self.close()
            if kind == "wrong":
                self._jump.start()
                self._jumped = True
        if kind == "stuck":
            t_ns = self._faults.end_ns("clock", t_ns)
        elif kind == "slow":
            t_ns += _SLOW_CYCLE_NS
        self._clock.sleep_until_ns(t_ns)

    def close(self) -> None:
        """Sets the wall clock right. May be called twice."""
        if self._jumped:
            self._jump.stop()
            self._jumped = False

    def _wrong_time(self) -> float:
        return self._right_time() - _DAY_S
