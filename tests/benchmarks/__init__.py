"""Benchmarks: how fast a fit is, beside what engineers would write themselves. `make bench` runs them."""
