"""Experiments in YAML: schema, checks with file positions, and stages."""
