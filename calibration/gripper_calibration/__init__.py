"""Fits and procedures that let a gripper know an object without a load cell."""
