"""Simulated rig: one MuJoCo world that drives the virtual servo, the camera and the load cell."""
