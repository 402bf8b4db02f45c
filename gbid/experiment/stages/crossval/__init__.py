"""Cross-validation: models on recordings to which they were not fitted."""
