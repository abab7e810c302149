"""Driver for Dynamixel X-series servos over the unmodified SDK, and a virtual Protocol 2.0 bus."""
