"""Templates of experiments that `gbid new` writes."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from gbid.errors import DataError, UsageError
from gbid.experiment.json_schema import experiment_json_schema
from gbid.share import share_folder
from gbid.structure import LinearModel

SCHEMA = "experiment.schema.json"
"""Name of the schema file beside an experiment; an editor completes and checks keys with it."""


def write_template(template: str, folder: Path) -> list[Path]:
    """Write the files of a template and the schema for editors into a new or empty folder: all of them or none.

    Parameters
    ----------
    template : {"quickstart", "own-recordings"}
        Name of the template.
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
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty; choose another folder")
    experiments = share_folder("experiments")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".part"))
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    try:
        if template == "quickstart":
            shutil.copyfile(experiments / "quickstart.yaml", part / "experiment.yaml")
        else:
            for file in sorted((experiments / "own_recordings").iterdir()):
                if file.suffix in (".yaml", ".py"):
                    shutil.copyfile(file, part / file.name)
            (part / "data").mkdir()
            for seed in (1, 2):
                write_example_data(part / "data" / f"run{seed}.csv", seed)
        _add_schema(part)
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o777 & ~mask)
        part.replace(folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _add_schema(folder: Path) -> None:
    """Write the schema, and name it in the first line of the experiment, where editors look for it."""
    schema = json.dumps(experiment_json_schema(), indent=2, ensure_ascii=False)
    (folder / SCHEMA).write_text(schema + "\n", encoding="utf-8")
    experiment = folder / "experiment.yaml"
    text = experiment.read_text(encoding="utf-8")
    experiment.write_text(f"# yaml-language-server: $schema={SCHEMA}\n{text}", encoding="utf-8")


def write_example_data(path: Path, seed: int, n_samples: int = 4000, sample_time: float = 5e-4) -> None:
    """Write a CSV file like that of a data logger: a mass on a spring, 40 Hz, damping factor 0.05, random input.

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
    model = LinearModel(
        np.array([[0.0, 1.0], [-(omega**2), -2 * 0.05 * omega]]),
        np.array([[0.0], [2.0]]),
        np.array([[1.0, 0.0]]),
        np.array([[0.0]]),
    )
    volt = np.repeat(random.choice([-1.0, 1.0], size=-(-n_samples // 8)), 8)[:n_samples]
    metre = model.simulate(volt[:, None], sample_time)[:, 0] + 2e-7 * random.standard_normal(n_samples)
    time = 1e3 * sample_time * np.arange(n_samples)
    rows = np.column_stack([time, volt, 1e6 * metre])
    np.savetxt(path, rows, delimiter=",", header="time [ms],drive [V],position [um]", comments="", fmt="%.6g")
