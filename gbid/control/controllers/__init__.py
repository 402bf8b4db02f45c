"""Controllers of fixed structure, scheduled ones, their files and their export to C."""
