"""Settings of the control chain on a real-time target."""
