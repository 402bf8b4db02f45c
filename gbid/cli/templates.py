"""Templates of experiments that `gbid new` writes."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from gbid.cli.example_data import write_example_data, write_held_bearing
from gbid.errors import DataError, UsageError
from gbid.experiment.json_schema import experiment_json_schema
from gbid.share import share_folder

SCHEMA = "experiment.schema.json"
"""Name of the schema file beside an experiment; an editor completes and checks keys with it."""

EXPERIMENT = "experiment.yaml"
_EXAMPLES = {
    "own_recordings": (write_example_data, ""),
    "magnetic_bearing": (write_held_bearing, "magnetic_bearing.py"),
}
"""Writer of the example data of each template with data, and the file of ``models`` that it takes along."""


def write_template(template: str, folder: Path) -> list[Path]:
    """Write the files of a template and the schema for editors into a new or empty folder: all of them or none.

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
    """Write an experiment and the schema for editors into a new or empty folder: both or none.

    Raises
    ------
    UsageError
        When the folder exists and is not empty.
    DataError
        When the folder cannot be written.
    """
    return _write(folder, lambda part: _write_text(part / EXPERIMENT, text))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _copy(source: Path, part: Path) -> None:
    """Copy a template, which is a file or a folder; a folder has example data made for it."""
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


def _write(folder: Path, fill: Callable[[Path], None]) -> list[Path]:
    refuse_used(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".part"))
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    try:
        fill(part)
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
    experiment = folder / EXPERIMENT
    text = experiment.read_text(encoding="utf-8")
    experiment.write_text(f"# yaml-language-server: $schema={SCHEMA}\n{text}", encoding="utf-8")
