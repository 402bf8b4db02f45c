"""Recordings of the virtual rig."""
