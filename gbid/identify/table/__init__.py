"""One table of many fits, and its file."""
