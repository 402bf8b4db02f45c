"""The nominal actuator: the most central of many models."""
