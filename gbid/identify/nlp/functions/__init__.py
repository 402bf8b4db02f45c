"""Functions of CasADi for the nonlinear programme of a fit."""
