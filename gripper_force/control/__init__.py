"""Control without I/O: fusion, force loop, phases and limits. Time is an argument."""
