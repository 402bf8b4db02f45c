"""Templates of experiments that `gbid new` writes, with example data in the form of a data logger."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import FloatArray
from gbid.core.errors import DataError, UsageError
from gbid.core.files import atomic_set, share_folder
from gbid.experiment.load import experiment_json_schema
from gbid.structure import LinearModel


def write_example_data(path: Path, seed: int, n_samples: int = 4000, sample_time: float = 5e-4) -> None:
    """Write a CSV file of a data logger: mass on a spring, 40 Hz, damping factor 0.05, random input.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    omega = 2 * np.pi * 40.0
    A = np.array([[0.0, 1.0], [-(omega**2), -2 * 0.05 * omega]])
    model = LinearModel(A, np.array([[0.0], [2.0]]), np.array([[1.0, 0.0]]), np.array([[0.0]]))
    volt = np.repeat(random.choice([-1.0, 1.0], size=-(-n_samples // 8)), 8)[:n_samples]
    metre = model.simulate(volt[:, None], sample_time)[:, 0] + 2e-7 * random.standard_normal(n_samples)
    time = 1e3 * sample_time * np.arange(n_samples)
    _save_csv(path, "time [ms],drive [V],position [um]", time, volt, 1e6 * metre)


def write_held_bearing(path: Path, seed: int, n_samples: int = 6000, sample_time: float = 1e-4) -> None:
    """Write a CSV file of a magnetic bearing under PD control, with a random current added to the controller output.

    The bearing has the negative stiffness 4e4 N/(kg m), the damping 2 N s/(kg m) and the gain 60 N/(kg A).

    Parameters
    ----------
    path : pathlib.Path
        The file.
    seed : int
        Seed of the random numbers.
    n_samples : int
        Number of samples.
    sample_time : float
        Time between samples [s].
    """
    random = np.random.default_rng(seed)
    stiffness, gain = 4e4, 60.0
    rate = stiffness**0.5  # the poles are about +- this, in 1/s
    cosh, sinh = np.cosh(rate * sample_time), np.sinh(rate * sample_time)
    A = np.array([[cosh, sinh / rate], [rate * sinh, cosh]])
    A[:, 1] *= np.exp(-2.0 * sample_time)  # damping
    B = gain * np.array([(cosh - 1) / stiffness, sinh / rate])
    added = np.repeat(random.choice([-0.15, 0.15], -(-n_samples // 20)), 20)[:n_samples]
    noise = 1e-6 * random.standard_normal(n_samples)
    current, position = np.empty(n_samples), np.empty(n_samples)
    x: FloatArray = np.zeros(2)
    before, velocity = 0.0, 0.0
    for k in range(n_samples):
        position[k] = x[0] + noise[k]
        velocity += 0.3 * ((position[k] - before) / sample_time - velocity)
        before = position[k]
        current[k] = added[k] - (5 * stiffness * position[k] + 2.8 * rate * velocity) / gain
        x = A @ x + B * current[k]
    time = 1e3 * sample_time * np.arange(n_samples)
    _save_csv(path, "time [ms],added [A],current [A],position [um]", time, added, current, 1e6 * position)


def _save_csv(path: Path, header: str, *columns: npt.NDArray[Any]) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.6g")


SCHEMA = "experiment.schema.json"
"""Name of the schema file beside an experiment; an editor completes and checks keys with it."""

EXPERIMENT = "experiment.yaml"
_EXAMPLES = {
    "own_recordings": (write_example_data, ""),
    "magnetic_bearing": (write_held_bearing, "magnetic_bearing.py"),
}
"""Writer of the example data of each template with data, and the file of ``models`` that it takes along."""


def write_template(template: str, folder: Path) -> list[Path]:
    """Write the files of a template and the editor schema into a new or empty folder: all or none.

    Parameters
    ----------
    template : str
        Name of the template, as `gbid new --list` shows it.
    folder : pathlib.Path
        Folder to write to.

    Returns
    -------
    list of pathlib.Path
        The files written.

    Raises
    ------
    UsageError
        When the folder exists and is not empty.
    DataError
        When the folder cannot be written.
    """
    source = share_folder("experiments") / template.replace("-", "_")
    return _write(folder, lambda part: _copy(source, part))


def write_draft(text: str, folder: Path) -> list[Path]:
    """Write an experiment and the editor schema into a new or empty folder: both or none.

    Raises
    ------
    UsageError
        When the folder exists and is not empty.
    DataError
        When the folder cannot be written.
    """
    return _write(folder, lambda part: (part / EXPERIMENT).write_text(text, encoding="utf-8"))


def _copy(source: Path, part: Path) -> None:
    """Copy a template, which is a file or a folder; a folder also gets example data."""
    if not source.is_dir():
        shutil.copyfile(source.with_suffix(".yaml"), part / EXPERIMENT)
        return
    for file in sorted(source.iterdir()):
        if file.suffix in (".yaml", ".py"):
            shutil.copyfile(file, part / file.name)
    (part / "data").mkdir()
    write, model = _EXAMPLES[source.name]
    for seed in (1, 2):
        write(part / "data" / f"run{seed}.csv", seed)
    if model:
        shutil.copyfile(share_folder("models") / model, part / model)


def refuse_used(folder: Path) -> None:
    """Refuse a folder that exists and is not empty.

    Raises
    ------
    UsageError
        When it is so.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty; choose another folder")


def _write(folder: Path, fill: Callable[[Path], object]) -> list[Path]:
    refuse_used(folder)
    try:
        with atomic_set(folder, overwrite=False) as part:
            fill(part)
            schema = json.dumps(experiment_json_schema(), indent=2, ensure_ascii=False)
            (part / SCHEMA).write_text(schema + "\n", encoding="utf-8")
            experiment = part / EXPERIMENT  # its first line names the schema, where editors look for it
            text = experiment.read_text(encoding="utf-8")
            experiment.write_text(f"# yaml-language-server: $schema={SCHEMA}\n{text}", encoding="utf-8")
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    return sorted(path for path in folder.rglob("*") if path.is_file())
