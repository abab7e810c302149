"""Conversion of recordings made elsewhere to logs."""
