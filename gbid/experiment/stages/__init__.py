"""Stages of an experiment, one file each: checks, tasks, and what follows from them."""
