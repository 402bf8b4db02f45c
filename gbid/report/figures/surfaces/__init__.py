"""Figures of the model over pressure and speed."""
