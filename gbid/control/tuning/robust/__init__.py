"""Robust design: damping at a stated probability over drawn plants, verified on fresh draws, and its price."""
