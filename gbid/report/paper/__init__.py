"""The figures and tables of the paper from an experiment's results, and both side by side."""
