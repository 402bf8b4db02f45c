"""Surfaces over pressure and speed, fitted directly to the recordings."""
