"""Table of many fits, and its file."""
