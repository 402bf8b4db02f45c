"""Start values of the search, in proportion to what the gains do to the loops."""
