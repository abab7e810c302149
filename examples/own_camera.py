"""A camera class of one's own, named in the configuration by its path: ``own_camera:PatternCamera``.

`PatternCamera` draws moving stripes; replace `_read` by a call of your camera's driver. Your module must be
importable: installed, or in the folder of the program.
"""

import numpy as np

import gripper_force as gf


class PatternCamera:
    """A gray camera. See `gripper_force.Camera` for the methods that it must have."""

    supports_lockstep = True
    """The times of its frames follow the run's clock, so it also works in simulated time."""

    def __init__(self, config: gf.CameraConfig, clock: gf.Clock) -> None:
        self._clock, self._period_ns = clock, round(1e9 / config.rate_hz)
        self._side_px = int(config.options.get("side_px", 128))
        self._start_ns: int | None = None  # None: not started, or closed
        self._seq = -1

    def start(self) -> None:
        self._start_ns = self._clock.now_ns()

    def newest(self) -> gf.Frame | None:
        if self._start_ns is None:
            return None
        now_ns = self._clock.now_ns()
        seq = (now_ns - self._start_ns) // self._period_ns
        if seq <= self._seq:
            return None  # never block: no frame since the last call
        self._seq = seq
        return gf.Frame(
            t_ns=self._start_ns + seq * self._period_ns, received_ns=now_ns, seq=seq, gray=self._read(seq)
        )

    def counts(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._start_ns = None

    def _read(self, seq: int) -> np.ndarray:
        stripes = (np.arange(self._side_px) + seq) // 8 % 2 * 120 + 60
        return np.broadcast_to(stripes, (self._side_px, self._side_px)).astype(np.uint8)


if __name__ == "__main__":
    overrides = {
        "camera.backend": "own_camera:PatternCamera",
        "camera.options": {"side_px": 64},
        "vision.checkpoint": "none",  # stripes show no contact: the loop uses motor current
        "control.feedback": "current",
    }
    with gf.open_gripper(overrides=overrides) as gripper:
        print(gripper.grasp(3.0))
        assert gripper.frame is not None
        print("newest frame:", gripper.frame.seq, gripper.frame.gray.shape)
        gripper.release()
