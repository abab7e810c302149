"""Guided setup of a rig, step by step, into one configuration file: see `gripper_calibration.setup.run`."""
