"""Surfaces over pressure and speed fitted to the recordings themselves (direct)."""
