"""Controllers of recordings in closed loop."""
