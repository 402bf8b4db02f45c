"""Tables of results: for each kind a document of plain values for programs, and a table of it for people."""
