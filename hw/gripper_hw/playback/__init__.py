"""Recordings as devices: a camera and a load cell that play a log, or a grasp imported from elsewhere.

At speed ``recorded`` they go as the clock goes, with times shifted to it; at speed ``full`` as fast as they
are asked, with times as recorded.
"""

from collections.abc import Iterator
from dataclasses import replace

from gripper_force.config import CameraConfig, LoadCellConfig
from gripper_force.errors import ConfigError, DataError
from gripper_force.interfaces import Clock
from gripper_force.runtime.log import LogReader
from gripper_force.types import Frame, LoadCellSample


class _Playback:
    """A log, and the time it is shifted by.

    Raises:
        ConfigError: No path is configured.
        LogError: The log can't be read.
    """

    def __init__(self, config: CameraConfig | LoadCellConfig, clock: Clock, unit: str) -> None:
        if config.path is None:
            raise ConfigError(f"{unit}.backend=playback needs {unit}.path, the log to play")
        self._log = LogReader(config.path)
        self._clock = clock
        self._speed = config.speed
        self._shift_ns = 0
        self._started = False

    def start(self) -> None:
        """Begins to play: the log's first record is now."""
        self._started = True
        if self._speed == "recorded":
            self._shift_ns = self._clock.now_ns() - self._log.start_ns

    def counts(self) -> dict[str, int]:
        """What went wrong when the log was made shows in its records."""
        return {}

    def _log_now_ns(self) -> int:
        return self._clock.now_ns() - self._shift_ns


class PlaybackCamera(_Playback):
    """Plays the frames of a log.

    At speed ``recorded``, `newest` is a camera's: frames that came while nobody asked are lost, and their
    numbers skipped. At speed ``full``, each call hands out the next frame. After the last it gives None.

    Args:
        config: Its section of the configuration: the log's path, and the speed.
        clock: The run's clock.

    Attributes:
        finished: True once the last frame was handed out.

    Raises:
        ConfigError: No path is configured.
        LogError: The log can't be read.
        DataError: It holds no frames.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config, clock, "camera")
        self._frames: Iterator[Frame] = self._log.records(Frame)
        self._next = next(self._frames, None)
        self.finished = False
        if self._next is None:
            raise DataError(f"{config.path} holds no camera frames to play")

    def newest(self) -> Frame | None:
        """The newest frame that was not handed out yet, or None. Never blocks. Raises `LogError`."""
        frame = None
        if self._speed == "full" and self._started:
            frame = self._take()
        elif self._started:
            log_ns = self._log_now_ns()
            while self._next is not None and self._next.received_ns <= log_ns:
                frame = self._take()
        self.finished = self._next is None
        if frame is None or not self._shift_ns:
            return frame
        return replace(
            frame, t_ns=frame.t_ns + self._shift_ns, received_ns=frame.received_ns + self._shift_ns
        )

    def close(self) -> None:
        """Stops playing. May be called twice."""
        self._next = None
        self._frames = iter(())

    def _take(self) -> Frame | None:
        frame, self._next = self._next, next(self._frames, None)
        return frame


class PlaybackLoadCell(_Playback):
    """Plays the load-cell samples of a log.

    At recorded speed, `drain` gives the samples up to now; at full speed, all of them at the first call.

    Args:
        config: Its section of the configuration: the log's path, and the speed.
        clock: The run's clock.

    Raises:
        ConfigError: No path is configured.
        LogError: The log can't be read.
        DataError: It holds no samples.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        super().__init__(config, clock, "load_cell")
        self._samples = list(self._log.records(LoadCellSample))
        self._taken = 0
        if not self._samples:
            raise DataError(f"{config.path} holds no load-cell samples to play")

    @property
    def finished(self) -> bool:
        """True once the last sample was handed out."""
        return self._taken == len(self._samples)

    def drain(self) -> list[LoadCellSample]:
        """Every sample since the last call, oldest first. Never blocks."""
        first = self._taken
        if self._speed == "full" and self._started:
            self._taken = len(self._samples)
        elif self._started:
            log_ns = self._log_now_ns()
            while not self.finished and self._samples[self._taken].t_ns <= log_ns:
                self._taken += 1
        return [replace(s, t_ns=s.t_ns + self._shift_ns) for s in self._samples[first : self._taken]]

    def close(self) -> None:
        """Stops playing. May be called twice."""
        self._taken = len(self._samples)
