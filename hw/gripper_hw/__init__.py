"""Devices and their stand-ins."""
