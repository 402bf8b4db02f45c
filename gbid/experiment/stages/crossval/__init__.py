"""Cross-validation: models on recordings that they were not fitted to."""
