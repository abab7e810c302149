"""Recording sets of touches from a press rig, and judging what was recorded."""
