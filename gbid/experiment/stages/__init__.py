"""Stages of an experiment, one file each: checks, tasks, and follow-up tasks."""
