"""Procedures: what to do with the devices so that a fit gets its numbers."""
