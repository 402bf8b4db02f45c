"""Figures and tables of the paper from the results of an experiment, and their comparison."""
