"""Recordings in files of one's own, and the experiments that read them."""

import numpy as np
from scipy.io import savemat

SIGNALS = """\
      r: {columns: [r_x, r_y], unit: um}
      u: {columns: [u_x, u_y], unit: um}
      p: {columns: [p_x, p_y], unit: um}
      phi: {columns: phi, unit: rad}
"""
BY_NAME = """\
format: 1
name: own
import:
  data_folder: data
  folder:
    pattern: "p{{pressure_bar:g}}_n{{speed_rpm:d}}_{{kind}}{{nr:d}}.{ending}"
    {clock}
    signals:
{signals}
"""
CLOCK = "sample_time_s: 2.0e-4"
BY_TABLE = """\
format: 1
name: own
import:
  data_folder: data
  table:
    file: runs.csv
    sample_time_s: 2.0e-4
    signals:
{signals}
"""
COLUMNS = [f"{signal}_{axis}" for signal in "rup" for axis in "xy"]


def columns_of(rec):
    values = {name: 1e6 * rec.signal(name[0])[:, "xy".index(name[2])] for name in COLUMNS}
    return {**values, "phi": rec.signal("phi")[:, 0]}


def write_file(path, columns):
    if path.suffix == ".csv":
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    elif path.suffix == ".npz":
        np.savez(path, **columns)
    else:
        savemat(path, columns)
