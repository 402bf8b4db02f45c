"""Prefilter: it removes run-out, offset and spikes from the recordings."""
