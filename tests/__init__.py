"""Tests, their support, and the benchmarks (`python -m tests.benchmarks.NAME`)."""
