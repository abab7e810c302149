"""What parts of a run cost on this machine, beside what others use: both take turns, so their ratio holds."""
