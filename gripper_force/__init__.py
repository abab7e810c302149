"""Visual force feedback for Dynamixel grippers."""

__version__ = "0.1.0"
