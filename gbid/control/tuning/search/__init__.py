"""Global and local search over the gains of many loops: problem, limits and steps."""
