"""A stage of one's own in one folder: the largest value of a signal of each recording."""
