"""Code behind drawings and tables of the pages."""
