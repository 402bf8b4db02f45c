"""Covariance of estimates for white and for coloured errors."""
