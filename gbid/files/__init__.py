"""Files that may be damaged: checksums, and a process of its own for libraries that may fail on them."""
