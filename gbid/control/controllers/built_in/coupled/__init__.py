"""Built-in structures with cross-coupling between the axes."""
