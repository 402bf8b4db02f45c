"""Methods for the points where the objective has no gradient: meeting eigenvalues, quasi-Newton steps, certificates."""
