"""Experiments in YAML: schema, checks with positions, and the stages that run them."""
