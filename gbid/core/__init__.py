"""What every package uses: arrays, errors, units, tables, notes, files."""
