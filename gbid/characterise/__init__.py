"""What recordings say without a dynamic model: static gains, linearity, hysteresis."""
