"""Disturbances of the outputs that are estimated along with the model: trends and hum."""
