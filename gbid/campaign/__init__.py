"""Campaigns of many fits: plan, engines, resuming, and the table of results."""
