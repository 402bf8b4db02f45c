"""Hammer impacts: half-sine response of a loop, impacts found in recordings, validation against a model."""
