"""Stages of an experiment, one folder each: schema, checks, plan, and the tasks that make the results."""
