"""Motion of the machine, by time stepping or in closed form."""
