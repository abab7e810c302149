"""Device drivers, simulated devices and playback of logs."""

from pathlib import Path
from typing import Final

UDEV_RULES: Final = Path(__file__).with_name("99-gripper-force.rules")
"""Rules for Linux that make a U2D2 fast and give access to an OAK camera and a Phidget bridge."""
