"""Performance of a design: figures over the operating points, comparison, and the stored design."""
