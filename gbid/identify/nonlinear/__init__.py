"""Nonlinear structures in a fit: predictor, kernel, and the error of the integration."""
