"""From camera frames to newtons."""
