"""Calibration of the load cell, servo, camera and objects of a gripper."""
