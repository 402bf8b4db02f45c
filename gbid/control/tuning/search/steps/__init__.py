"""Steps of the local optimisation: quadratic programmes over the functions near the worst one."""
