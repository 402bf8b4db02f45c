"""Nonlinear structures: equations of a user, their symbols, and the model at given parameters."""
