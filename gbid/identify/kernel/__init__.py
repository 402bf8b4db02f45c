"""Passes over the samples: blocks, recursions, and the engines (compiled or numpy) that run them."""
