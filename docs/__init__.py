"""Pages of the documentation, and the code behind their drawings and tables."""
