"""Closed loops: sensitivities, peak gains, margins, damping, half-sine impacts, and the sampled loop."""
