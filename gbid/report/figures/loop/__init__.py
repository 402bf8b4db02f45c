"""Figures of the closed loop and of impacts."""
