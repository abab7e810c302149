"""A camera and a load cell that play a recording."""
