"""Drivers for load cells: boards and weighing indicators on a serial port, and Phidget bridges."""
