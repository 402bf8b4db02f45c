"""The nonlinear programme of a fit: multiple shooting, scaling, derivatives and the solver."""
