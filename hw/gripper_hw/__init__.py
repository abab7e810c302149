"""Device drivers, simulated devices and playback of logs."""
