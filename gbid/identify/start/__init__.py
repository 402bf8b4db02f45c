"""Start values of a fit: from the structure, from the caller, or from data."""
