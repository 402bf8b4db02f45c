"""Excitation of the virtual rig: PRBS, staircases, hammer impacts and run-ups."""
