"""Hammer impacts: impacts in recordings, ring-down fits, validation of models, and studies."""
