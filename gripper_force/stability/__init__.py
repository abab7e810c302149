"""What a run must survive: hostile input, a long life, and failing parts."""
