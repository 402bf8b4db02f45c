"""Motion of the rig's machine, sample by sample or in closed form."""
