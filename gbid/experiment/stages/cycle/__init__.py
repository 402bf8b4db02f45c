"""Identification-for-control cycle: the tuned controller runs on the rig, and what it records makes the next one."""
