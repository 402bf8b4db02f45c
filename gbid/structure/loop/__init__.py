"""Closed loop of a structure and a controller, as a structure."""
