"""Figures of recordings, characterisations, fits and their validation."""
