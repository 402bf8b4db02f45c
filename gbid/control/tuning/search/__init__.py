"""Global and local search over the gains of many loops: the problem, its limits, and the steps."""
