"""Base of all packages: arrays, errors, units, tables, notes, files."""
