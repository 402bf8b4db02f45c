"""Figures of a linear model with its uncertainty, for any model and fit."""
