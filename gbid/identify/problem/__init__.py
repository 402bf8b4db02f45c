"""From recordings and options to the shooting problem."""
