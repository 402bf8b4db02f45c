"""Basins of local optima: climbs from start values, and random moves from one basin to another."""
