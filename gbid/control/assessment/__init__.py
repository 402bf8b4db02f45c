"""Assessment of control designs: figures over the operating points, comparison, and storage."""
