"""Experiments for the tests, and the command line called within this process."""

import json
import shutil
from pathlib import Path

import numpy as np

from gbid.cli.main import app

QUICK = """\
format: 1
name: quick
rig:
  seed: 3
  operating_points:
    - {pressure_bar: 5.0, speed_rpm: 6000}
  duration_s: 1.0
  prbs: {recordings: 2, amplitude_m: 4.5e-6, hold_s: 20e-3}
  stationary: {recordings: 1}
  sensors: {noise_p_m: 30e-9}
prefilter:
  harmonics: 6
fits:
  bearing: {structure: rotor_bearing, options: {disturbance_gain: diagonal}, stop: paper}
  piezos: {structure: piezo_pair}
crossval:
  bearing: {on: cyclic, minimum_percent: 90}
figures:
  bearing: {from_s: 0.2, to_s: 0.4}
"""

SPRING = """\
format: 1
name: spring
import:
  data_folder: data
  recordings:
    - name: run1
      file: run1.csv
      time: time
      signals: {u: {columns: drive, stored_unit: V, channels: u}, y: {columns: position, stored_unit: um}}
    - name: run2
      file: run2.csv
      time: time
      signals: {u: {columns: drive, stored_unit: V, channels: u}, y: {columns: position, stored_unit: um}}
fits:
  spring: {structure: "spring.py:structure", focus: simulation}
crossval:
  spring: {on: cyclic, minimum_percent: 90}
"""

SPRING_STRUCTURE = """\
import gbid

def matrices(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}

structure = gbid.LinearStructure(
    "spring", [gbid.Parameter("k", 6e4), gbid.Parameter("d", 20.0), gbid.Parameter("b", 1e6)], matrices)
"""


def gbid(*arguments) -> int:
    """Exit code of a command line."""
    try:
        app([str(a) for a in arguments], prog_name="gbid")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def printed_by(capsys, *arguments, code: int = 0):
    """What a command line prints, to stdout and stderr; it ends with the exit code."""
    capsys.readouterr()
    assert gbid(*arguments) == code
    return capsys.readouterr()


def json_of(capsys, *arguments, code: int = 0) -> dict:
    """The document that a command line prints with `--json`, without numbers that JSON does not know."""
    return json.loads(printed_by(capsys, *arguments, "--json", code=code).out, parse_constant=_no_constants)


def _no_constants(name: str) -> None:
    raise AssertionError(f"{name} in JSON")


def files_in(folder: Path) -> list[str]:
    """Paths of the files below a folder."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def write_quick(folder: Path, *changes: tuple[str, str], text: str = QUICK) -> Path:
    """The quick experiment with some of its text changed."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "experiment.yaml"
    path.write_text(text)
    return path


def write_spring(folder: Path, *changes: tuple[str, str]) -> Path:
    """An experiment on two csv files and a structure of its own: a mass on a spring, by exact recursion."""
    path = write_quick(folder, *changes, text=SPRING)
    (folder / "spring.py").write_text(SPRING_STRUCTURE)
    for seed in (1, 2):
        write_spring_data(folder / "data" / f"run{seed}.csv", seed)
    return path


def write_spring_data(path: Path, seed: int, n: int = 1500, dt: float = 5e-4, damage=None) -> None:
    """What a mass on a spring does under random steps: the exact recursion from its poles."""
    random = np.random.default_rng(seed)
    omega, zeta = 2 * np.pi * 40, 0.05
    pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    u = np.repeat(random.choice([-1.0, 1.0], n // 10 + 1), 10)[:n]
    y, z = np.zeros(n), 0j
    step = np.exp(pole * dt)
    for k in range(n):  # modal state: z' = pole z + u, y = Im(z) 2e6 / Im(pole) solves the spring with b = 2e6
        y[k] = 2e6 * z.imag / pole.imag
        z = step * z + (step - 1) / pole * u[k]
    y += 0.2 * random.standard_normal(n)
    columns = {"time [s]": dt * np.arange(n), "drive [V]": u, "position [um]": y}
    if damage is not None:
        damage(columns)
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")


def copy_results(source: Path, target: Path) -> Path:
    shutil.copytree(source, target)
    return target


SMALL = """\
format: 1
name: small
rig:
  seed: 5
  operating_points:
    - {pressure_bar: 3, speed_rpm: 0}
    - {pressure_bar: 3, speed_rpm: 6000}
    - {pressure_bar: 6, speed_rpm: 0}
    - {pressure_bar: 6, speed_rpm: 6000}
  duration_s: 0.4
  prbs: {recordings: 2, amplitude_m: 1.5e-6, hold_s: 4e-3}
  stationary: {recordings: 1, duration_s: 1.0}
prefilter: {harmonics: 6}
fits:
  bearing: {structure: rotor_bearing, focus: simulation}
lpv: {fit: bearing, order: ["1", P, Omega, Omega P], actuators: theisen2016}
"""

STAIRS = """\
format: 1
name: stairs
rig:
  seed: 3
  operating_points:
    - {pressure_bar: 6.0, speed_rpm: 0}
  duration_s: 0.5
  prbs: {recordings: 0}
  stationary: {recordings: 0}
  actuators: {kind: stacks}
  staircase: {hold_s: 0.2}
  stack_staircase: {hold_s: 0.2, controlled: [false]}
static:
  film: {recordings: "p6_n0_stairs_*", keep: 0.4}
  stack4: {recordings: "p6_n0_stack4_open1", kind: piezo, command: v, position: y_p, channel: "4"}
"""
