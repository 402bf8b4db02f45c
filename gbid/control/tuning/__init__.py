"""Tuning of gains: goals, plants, search and certificates of optimality."""
