"""Excitations of the next recordings, designed from the fits."""
