"""Gains with the most closed-loop damping within limits."""
