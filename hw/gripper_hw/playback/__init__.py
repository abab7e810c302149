"""Playback: a camera and a load cell that return the frames and samples of a log, recorded or imported.

At speed ``recorded``, data come at the pace of the clock, with times shifted to it. At speed ``full``, each
call returns the next data, with times as recorded.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from gripper_force.config import CameraConfig, LoadCellConfig
from gripper_force.errors import ConfigError, DataError
from gripper_force.interfaces import Clock
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S, Frame, LoadCellSample


class _PlaybackDevice:
    """A log, and the shift of its times to the run's clock.

    Raises:
        ConfigError: No path is configured.
        LogError: The log cannot be read.
    """

    supports_lockstep = True

    def __init__(self, config: CameraConfig | LoadCellConfig, clock: Clock, unit: str) -> None:
        if config.path is None:
            raise ConfigError(f"{unit}.backend=playback needs {unit}.path; set it to the log to play")
        self._log = LogReader(config.path)
        self._clock = clock
        self._speed = config.speed
        self._shift_ns = 0
        self._started = False

    def start(self) -> None:
        """Starts playback: the log's first record is played now."""
        self._started = True
        if self._speed == "recorded":
            self._shift_ns = self._clock.now_ns() - self._log.start_ns

    def counts(self) -> dict[str, int]:
        """Returns an empty mapping: playback loses nothing; faults of the recording are in its records."""
        return {}

    def _log_now_ns(self) -> int:
        return self._clock.now_ns() - self._shift_ns


_RATE_FRAMES = 120
"""Frames over which the rate of a log is measured."""


class PlaybackCamera(_PlaybackDevice):
    """Plays the frames of a log.

    At speed ``recorded``, `newest` skips frames as a real camera does if it is called too rarely. At speed
    ``full``, each call returns the next frame. After the last frame the result is None.

    Args:
        config: The camera section of the configuration: the log's path, and the speed.
        clock: The run's clock.

    Attributes:
        finished: True after the last frame was returned.

    Raises:
        ConfigError: No path is configured.
        LogError: The log cannot be read.
        DataError: The log holds no frames.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config, clock, "camera")
        self._frames: Iterator[Frame] = self._log.records(Frame)
        self._next = next(self._frames, None)
        self.finished = False
        if self._next is None:
            raise DataError(
                f"{config.path} holds no camera frames to play; choose another log, or camera.backend=none"
            )

    @staticmethod
    def resolve(config: CameraConfig) -> CameraConfig:
        """Replaces ``rate_hz`` by the frame rate of the log.

        Raises:
            LogError: The log cannot be read.
            DataError: Its frames do not have a rate that ``camera.rate_hz`` may have.
        """
        if config.path is None:  # the constructor refuses it
            return config
        frames = list(islice(LogReader(config.path).records(Frame), _RATE_FRAMES))
        span_ns = frames[-1].t_ns - frames[0].t_ns if frames else 0
        if span_ns <= 0:
            return config
        rate_hz = (frames[-1].seq - frames[0].seq) * NS_PER_S / span_ns
        if not 0.1 <= rate_hz <= 1000:
            raise DataError(f"{config.path} has {rate_hz:.3g} frames/s; play a log with 0.1 to 1000 frames/s")
        return config.model_copy(update={"rate_hz": round(rate_hz, 2)})

    def newest(self) -> Frame | None:
        """Returns the newest frame that was not returned yet, or None. Never blocks. Raises `LogError`."""
        frame = None
        if self._speed == "full" and self._started:
            frame = self._advance()
        elif self._started:
            log_ns = self._log_now_ns()
            while self._next is not None and self._next.received_ns <= log_ns:
                frame = self._advance()
        self.finished = self._next is None
        if frame is None or not self._shift_ns:
            return frame
        return replace(
            frame, t_ns=frame.t_ns + self._shift_ns, received_ns=frame.received_ns + self._shift_ns
        )

    def close(self) -> None:
        """Stops playback. May be called twice."""
        self._next = None
        self._frames = iter(())

    def _advance(self) -> Frame | None:
        frame, self._next = self._next, next(self._frames, None)
        return frame


class PlaybackLoadCell(_PlaybackDevice):
    """Plays the load-cell samples of a log.

    At speed ``recorded``, `drain` returns the samples up to now; at speed ``full``, all at the first call.

    Args:
        config: The load cell section of the configuration: the log's path, and the speed.
        clock: The run's clock.

    Raises:
        ConfigError: No path is configured.
        LogError: The log cannot be read.
        DataError: The log holds no samples.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        super().__init__(config, clock, "load_cell")
        self._samples = list(self._log.records(LoadCellSample))
        self._returned = 0
        if not self._samples:
            raise DataError(
                f"{config.path} holds no load-cell samples to play; choose another log, or "
                "load_cell.backend=none"
            )

    @property
    def finished(self) -> bool:
        """True after the last sample was returned."""
        return self._returned == len(self._samples)

    def drain(self) -> list[LoadCellSample]:
        """Returns all samples since the last call, oldest first. Never blocks."""
        first = self._returned
        if self._speed == "full" and self._started:
            self._returned = len(self._samples)
        elif self._started:
            log_ns = self._log_now_ns()
            while not self.finished and self._samples[self._returned].t_ns <= log_ns:
                self._returned += 1
        return [replace(s, t_ns=s.t_ns + self._shift_ns) for s in self._samples[first : self._returned]]

    def close(self) -> None:
        """Stops playback. May be called twice."""
        self._returned = len(self._samples)
