"""Robust loss of a fit: outliers weigh less."""
