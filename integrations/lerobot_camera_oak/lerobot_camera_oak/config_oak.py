"""Configuration of the camera ``oak``."""

from dataclasses import dataclass

from lerobot.cameras import CameraConfig


@CameraConfig.register_subclass("oak")
@dataclass(kw_only=True)
class OakCameraConfig(CameraConfig):
    """The gray, square image of an OAK camera.

    Except for ``fps``, ``width`` and ``height`` the keys are those of the section ``camera`` of gripper-force
    (docs/configuration.md), with its defaults.

    Attributes:
        fps: Frames per second.
        width: Side of the image in pixels.
        height: The same: the image is a square.
        device: Id or address of the device; None: the only one.
        sensor: Socket (CAM_B) or name (OV7251) of the sensor; None: the mono sensor on the lowest socket.
        resolution_px: Width and height of a mode of the sensor; None: chosen by ``fps``.
        region: Region of the sensor image (left, top, width, height) whose central square becomes the image.
        exposure_us: Exposure time; None: automatic.
        gain: ISO; needs an exposure time.
        lens_position: Focus of a lens with autofocus, 0 to 255.
        white_balance_k: Colour temperature of a colour sensor.
        timeout_ms: Age of the newest frame after which the camera counts as lost.
    """

    fps: int | None = 30
    width: int | None = 128
    height: int | None = 128
    device: str | None = None
    sensor: str | None = None
    resolution_px: tuple[int, int] | None = None
    region: tuple[int, int, int, int] | None = None
    exposure_us: int | None = 4000
    gain: int | None = None
    lens_position: int | None = None
    white_balance_k: int | None = None
    timeout_ms: float = 250.0

    def __post_init__(self) -> None:
        """Checks the size. Raises ``ValueError``."""
        if self.width != self.height or self.width is None:
            raise ValueError(
                f"the image of an OAK camera is a square, not {self.width}x{self.height}; set width and height "
                "to the same number"
            )
