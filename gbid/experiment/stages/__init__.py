"""The stages of an experiment, a folder each: schema, checks, plan, and what makes its results."""
