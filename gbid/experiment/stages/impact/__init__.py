"""Hammer impacts on the rig, in open and closed loop."""
