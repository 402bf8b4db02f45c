"""Figures of the LPV model over pressure and speed."""
