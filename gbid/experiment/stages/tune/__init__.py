"""Controllers whose gains are tuned."""
