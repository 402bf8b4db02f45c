"""Command line: verbs that read the options, call the library and print."""
