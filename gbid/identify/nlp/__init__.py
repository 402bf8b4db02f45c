"""Nonlinear programme of a fit: multiple shooting, derivatives and the solver."""
