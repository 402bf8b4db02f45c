"""Hammer impacts on the rig, open and closed loop."""
