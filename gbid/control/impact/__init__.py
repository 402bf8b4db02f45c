"""Hammer impacts: simulated response of a loop, impacts found in recordings, validation of a model."""
