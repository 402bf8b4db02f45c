"""Surfaces over pressure and speed fitted to many models (two-step)."""
