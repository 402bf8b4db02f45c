"""Structure of a user, loaded from a Python file."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from gbid.errors import UsageError
from gbid.structure.any_structure import AnyStructure, anatomy
from gbid.structure.linear import in_one_line
from gbid.structure.numeric.linear_model import LinearModel

_REMEDY = "make it a gbid.LinearStructure or gbid.NonlinearStructure"


def load_structure(reference: str, folder: Path | None = None) -> AnyStructure:
    """Return the structure named as ``file.py:name``.

    Parameters
    ----------
    reference : str
        Python file and name in it: a structure, or a function without arguments that returns one.
    folder : pathlib.Path, optional
        Folder for a relative file name; the current folder when not given.

    Returns
    -------
    Structure
        The structure, after a check of the sizes of its equations.

    Raises
    ------
    UsageError
        When the file is missing, when its import fails, when it has no such name, or when its equations do not fit.
    """
    found = load_structure_or_model(reference, folder)
    if isinstance(found, LinearModel):
        file, _, name = reference.rpartition(":")
        raise UsageError(f"{(folder or Path()) / file}: {name} is not a structure; {_REMEDY}")
    return found


def load_structure_or_model(reference: str, folder: Path | None = None) -> AnyStructure | LinearModel:
    """Return the structure or the model with numbers named as ``file.py:name``; see `load_structure`.

    Raises
    ------
    UsageError
        As `load_structure`, but for a `LinearModel`.
    """
    file, separator, name = reference.rpartition(":")
    if not separator or not file.endswith(".py"):
        raise UsageError(f"structure {reference!r}: write it as file.py:name")
    path = (folder or Path()) / file
    if not path.is_file():
        raise UsageError(f"structure {reference!r}: no file {path}")
    spec = importlib.util.spec_from_file_location(f"gbid_user_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise UsageError(f"{path}: import failed: {in_one_line(error)}") from error
    if not hasattr(module, name):
        raise UsageError(f"{path}: no name {name!r} in this file")
    found = getattr(module, name)
    if not isinstance(found, AnyStructure | LinearModel) and callable(found):
        try:
            found = found()
        except Exception as error:
            raise UsageError(f"{path}: {name}() failed: {in_one_line(error)}") from error
    if isinstance(found, LinearModel):
        return found
    if not isinstance(found, AnyStructure):
        raise UsageError(f"{path}: {name} is not a structure; {_REMEDY}")
    try:
        anatomy(found)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error
    return found
