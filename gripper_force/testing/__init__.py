"""Contract suites for devices and engines, to run on a class of one's own with pytest."""
