"""Figures of the calibrations, one module each."""
