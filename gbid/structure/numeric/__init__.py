"""Linear models in numbers: matrices, simulation, frequency response, and the objects of other libraries."""
