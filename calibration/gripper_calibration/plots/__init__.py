"""The pictures of calibrations, one module each."""
