"""Fits of a structure to recordings."""
