"""Reading and writing of model files."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from gbid.atomic import atomic_path
from gbid.errors import UsageError
from gbid.lpv.basis import TERMS
from gbid.lpv.model import LPVModel
from gbid.lpv.model_file import SCHEMA_VERSION, SI_UNITS, parse
from gbid.naming.paths import given_path
from gbid.share import share_folder
from gbid.yaml_file import read_yaml, write_yaml


def load_model(name_or_path: str | Path) -> LPVModel:
    """Return a model that comes with gbid, or one from a file.

    Parameters
    ----------
    name_or_path : str or path
        A name such as ``"theisen2016"``, or the path of a YAML file (with its ending, or with a folder).

    Returns
    -------
    LPVModel
        The model in SI per kg, with the corrections of the file applied.

    Raises
    ------
    UsageError
        When the name is unknown or the file is missing. For a faulty file the text gives line and column of each
        problem.

    Examples
    --------
    >>> model = load_model("theisen2016")
    >>> [round(frequency, 1) for frequency, damping in model.at(6, 0).modes()]
    [126.6, 132.1]
    """
    path = given_path(name_or_path)
    if path.suffix not in (".yaml", ".yml") and len(path.parts) <= 1:
        folder = share_folder("models")
        path = folder / f"{name_or_path}.yaml"
        if not path.is_file():
            names = ", ".join(sorted(file.stem for file in folder.glob("*.yaml")))
            raise UsageError(
                f"no model {str(name_or_path)!r} comes with gbid; there are: {names} (or give a path to a .yaml file)"
            )
    return parse(read_yaml(path))


def save_model(model: LPVModel, path: str | Path, overwrite: bool = False) -> None:
    """Write a model as a YAML file that `load_model` reads back without loss.

    Parameters
    ----------
    model : LPVModel
        The model. Its coefficients are written in SI, with corrections already applied.
    path : str or path
        The new file, ending in .yaml.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, or when it has another ending.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a model file ends in .yaml")
    with atomic_path(path, overwrite) as part:
        write_model(model, part)


def write_model(model: LPVModel, path: Path, comment: str = "") -> None:
    """Write a model as YAML, with an optional comment as the first line."""
    write_yaml(_contents(model), path, comment)


def _contents(model: LPVModel) -> dict[str, Any]:
    """Return the contents of a model file, without empty entries."""
    contents: dict[str, Any] = {
        "kind": "lpv_model",
        "schema_version": SCHEMA_VERSION,
        "name": model.name,
        "title": model.title,
        "source": model.source,
        "domain": asdict(model.domain),
        "pade_order": model.pade_order,
        "operating_points": [list(point) for point in model.operating_points],
        "key_parameters": {
            "terms": list(TERMS),
            "unit": dict(SI_UNITS),
            "scale": dict.fromkeys(SI_UNITS, 1.0),
            "coefficients": {key: list(values) for key, values in model.coefficients.items()},
        },
        "applied_corrections": [asdict(correction) for correction in model.corrections],
        "actuators": dict(model.actuators),
        "controller": asdict(model.controller) if model.controller else None,
        "reference_modes": [asdict(modes) for modes in model.reference_modes],
        "rig": {name: asdict(quantity) for name, quantity in model.rig.items()},
        "piezo_controllers": asdict(model.piezo_controllers) if model.piezo_controllers else None,
    }
    return {key: value for key, value in contents.items() if value not in (None, "", [], {})}
