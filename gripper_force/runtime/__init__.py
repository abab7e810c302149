"""Runtime of one gripper: devices, perception, control cycle and log."""
