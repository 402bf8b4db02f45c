"""Sections of the page, a file each: results in, blocks out."""
