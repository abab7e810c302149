"""Numerically hard cases for the network, the fusion filter, the head fit and the simulator."""
