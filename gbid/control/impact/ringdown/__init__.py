"""Modes identified from the ring-down after hammer impacts."""
