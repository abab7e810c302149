"""Pure control: fusion, force loop, phases and limits. No I/O, and time is an argument."""
