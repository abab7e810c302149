"""Dynamixel servos over the unmodified SDK, and a virtual bus that answers Protocol 2.0."""
