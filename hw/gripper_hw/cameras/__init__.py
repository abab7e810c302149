"""Real cameras."""
