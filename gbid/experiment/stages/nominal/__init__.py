"""Nominal actuator: the most central of many models."""
