"""Command line: verbs, which read the options, call the library and print."""
