"""Surfaces over pressure and speed, fitted to the key parameters of the fits."""
