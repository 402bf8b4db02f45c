"""Surfaces over pressure and speed through the fits."""
