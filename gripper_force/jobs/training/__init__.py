"""Training a force network: how it is asked for, what a step sees, one process or several, and the result."""
