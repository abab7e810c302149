"""Recording of sets of touches from a press rig, and checks of the recorded sets."""
