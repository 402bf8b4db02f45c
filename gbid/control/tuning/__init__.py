"""Tuning: gains with the largest closed-loop damping within limits."""
