"""What every room uses: arrays, errors, units, tables, notes, files."""
