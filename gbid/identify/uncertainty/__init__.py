"""Uncertainty of a fit: covariances, residual tests, profile likelihoods, standard deviations of responses."""
