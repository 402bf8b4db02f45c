"""The machine of the virtual rig: truth, piezo stacks, sensors, and what differs between recordings."""
