"""Command line: one small module per verb, which reads the options, calls the library and prints."""
