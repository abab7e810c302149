"""Fits: arrays in, calibrated values with intervals out. They use no devices and no files."""
