"""Machine of the virtual rig: true parameters, piezo stacks, sensors, and scatter between recordings."""
