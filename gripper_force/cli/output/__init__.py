"""What each command prints for a person."""
