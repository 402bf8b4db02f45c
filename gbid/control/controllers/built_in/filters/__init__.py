"""Built-in structures that are filters of second or other order per axis."""
