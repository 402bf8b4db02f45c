"""Identification of modes from the ring-down after hammer impacts."""
