"""Gains that are optimised: goals, plants, search, certificates."""
