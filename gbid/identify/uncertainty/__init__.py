"""Covariance of the estimates, for white and for coloured errors."""
