"""Run of an experiment: job, tasks, engines, outcomes, and the record of failures."""
