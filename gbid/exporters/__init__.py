"""Export of what an experiment has made: models and controllers to files of other programs, one target a file."""
