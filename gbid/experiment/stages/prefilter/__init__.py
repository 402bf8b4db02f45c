"""Prefilter: run-out, offset and spikes are taken out of the recordings."""
