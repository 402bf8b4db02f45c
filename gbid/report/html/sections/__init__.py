"""Sections of the page, one file each: functions from results to blocks."""
