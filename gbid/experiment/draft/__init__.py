"""Draft of an experiment for a gas bearing from a folder of measured files."""
