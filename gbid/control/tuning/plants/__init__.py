"""Plants of a design as loops with common gains: at operating points, drawn, given as models, continuous or sampled."""
