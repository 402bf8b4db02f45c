"""Fuzzing of everything that reads files: mutated files, bounded processes, and what came of each input."""
