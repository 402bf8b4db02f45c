"""Controllers of fixed structure, scheduled controllers, their files and their export to C."""
