"""Static characterisation: maps and curves from staircases."""
