"""Profiles: calibrated data of a rig and of an object, and their application to a run."""
