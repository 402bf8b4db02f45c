"""Shooting problem of a fit, from recordings and options."""
