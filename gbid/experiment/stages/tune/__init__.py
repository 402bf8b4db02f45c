"""Controllers with tuned gains."""
