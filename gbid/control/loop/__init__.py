"""Closed loops and their figures: sensitivities, peak gains, margins, damping, and the loop as it runs sampled."""
