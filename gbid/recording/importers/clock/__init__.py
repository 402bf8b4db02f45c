"""Clock of an import: its sample time, its gaps, and samples that are not evenly spaced."""
