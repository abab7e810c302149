"""Conversion of logs to formats of other software."""
