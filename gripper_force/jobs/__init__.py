"""Jobs: grasp, replay, record, simulate, import, train, evaluate, doctor."""
