"""What runs the tasks of an experiment: job, engines, outcomes, and failures remembered on disk."""
