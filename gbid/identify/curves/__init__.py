"""Curves of a model with their uncertainty: frequency response, poles and zeros, step and impulse responses."""
