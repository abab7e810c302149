"""Calibration procedures: they operate the devices or read logs, run a fit, and write a profile and a figure."""
