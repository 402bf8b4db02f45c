"""Signals: spectra by convex design, phases of small peaks, binary sequences."""
