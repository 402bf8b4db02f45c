"""What drives a recording of the rig: PRBS, staircases, hammer impacts, run-ups."""
