"""Recordings imported from files."""
