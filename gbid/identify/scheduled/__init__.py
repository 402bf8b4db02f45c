"""Fits of structures whose parameters follow signals of the recordings."""
