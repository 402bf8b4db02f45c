"""Structures whose parameters are polynomials in signals of the recording."""
