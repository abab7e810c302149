"""Gain margins of the force loop over stiffness and delay."""
