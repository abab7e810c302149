"""Fits: numbers in, values with intervals out; no device, no file."""
