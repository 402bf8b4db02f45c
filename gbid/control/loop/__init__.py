"""Closed loops: sensitivities, peak gains, margins, damping, and the sampled loop."""
