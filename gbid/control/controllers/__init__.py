"""Controllers: built-in and user-defined structures, scheduled gains, and controller files."""
