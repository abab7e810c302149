"""The fault matrix: each part fails during a grasp, and the log is judged."""
