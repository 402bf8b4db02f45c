"""Start values of a fit from its data."""
