"""Shooting problem of a fit: assembly, cost and derivatives, solution by IPOPT, refinements."""
