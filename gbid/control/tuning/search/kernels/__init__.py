"""Compiled kernels of the search: peaks over frequency, and gradients of peaks and eigenvalues."""
