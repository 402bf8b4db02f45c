"""Reader of MATLAB files of all versions, with their objects, by mat-io."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gbid.core.errors import DataError
from gbid.recording.mapping import nearest
from gbid.recording.readers import SAVE_PLAIN, FileChannel, FileFormat, MatObject, array_channels, class_of, opened
from gbid.recording.text_files import FileColumn, pick_column, split_reference

_DEPTH = 5  # of nested structs that are listed


def read_mat(path: Path, references: Sequence[str]) -> dict[str, FileColumn]:
    """Return the named columns of a MATLAB file of any version.

    Arrays have the shape that MATLAB shows. This also holds for v7.3 files, which store arrays transposed. Fields of
    structs, properties of objects (`timeseries`, `iddata`, classes of one's own) and variables of tables have dotted
    names.

    Raises
    ------
    DataError
        When the file is damaged or not a MATLAB file, when a variable or field is missing, or when it is not an array
        of numbers with that column.
    """
    paths = {reference: split_reference(reference)[0].split(".") for reference in references}
    with path.open("rb"):  # the library wraps the error of a file that is not there
        pass
    variables, classes = _load(path, sorted({parts[0] for parts in paths.values()}))
    columns = {}
    for reference, parts in paths.items():
        if parts[0] not in classes:
            raise DataError(f"{path}: no variable {parts[0]!r}; {nearest(parts[0], classes)}")
        value = _walk(path, reference, variables[parts[0]], parts)
        if kind := class_of(value):
            raise DataError(f"{path}: column {reference!r}: {'.'.join(parts)} is a MATLAB {kind}; {_rather(value)}")
        columns[reference] = FileColumn(pick_column(path, reference, value, row_vectors=True))
    return columns


def mat_channels(path: Path) -> list[FileChannel]:
    """Return the channels of a MATLAB file, also those in structs, objects and tables.

    Raises
    ------
    DataError
        When the file is damaged or not a MATLAB file.
    """
    with path.open("rb"):
        pass
    variables, classes = _load(path, None)
    found = [channel for name in classes for channel in _listed(name, opened(variables[name]))]
    return [channel for channel in found if channel.n_samples or channel.remark]


def _listed(name: str, value: Any, depth: int = 0) -> list[FileChannel]:
    """Return the channels of a variable; those of structs and objects down to a few levels."""
    if isinstance(value, Mapping) and depth < _DEPTH:
        inside = [_listed(f"{name}.{field}", opened(value[field], inside=value), depth + 1) for field in value]
        return [channel for channels in inside for channel in channels]
    if kind := class_of(value):
        return [FileChannel(name, 0, remark=f"MATLAB {kind}: not read")]
    return array_channels(name, value, row_vectors=True)


def _load(path: Path, roots: list[str] | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the variables (all, when no roots are given), and the classes of all variables by name."""
    classes: dict[str, str] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an option of pandas, and of objects returned as they are stored
        from matio import load_from_mat, whosmat  # imported here, because the import takes half a second

        try:
            classes = {name: str(kind) for name, (_, kind) in whosmat(str(path)).items()}
            wanted = [name for name in classes if roots is None or name in roots]
            return (load_from_mat(str(path), variable_names=wanted) if wanted else {}), classes
        except Exception as error:  # a damaged file can raise any kind of error in the reader
            there = ", ".join(f"{name} ({classes[name]})" for name in classes if roots and name in roots)
            which = f" at {there}" if there else ""
            raise DataError(
                f"{path}: not a readable MATLAB file{which} (truncated or of another format): {error}; {SAVE_PLAIN}"
            ) from None


def _walk(path: Path, reference: str, value: Any, parts: list[str]) -> Any:
    """Return the field of nested structs and objects that the dots of a reference name."""
    value = opened(value)
    for depth, part in enumerate(parts[1:], start=1):
        struct = ".".join(parts[:depth])
        if not isinstance(value, Mapping):
            kind = class_of(value)
            rather = f", but a MATLAB {kind}; {SAVE_PLAIN}" if kind else ""
            raise DataError(f"{path}: column {reference!r}: {struct} is not a struct with fields{rather}")
        if part not in value:
            rather = f" (MATLAB {value.kind}; {SAVE_PLAIN})" if isinstance(value, MatObject) else ""
            known = nearest(part, value)
            raise DataError(f"{path}: column {reference!r}: {struct} has no field {part!r}; {known}{rather}")
        value = opened(value[part], inside=value)
    return value


def _rather(value: Any) -> str:
    """Return what to write in place of the name of a whole object."""
    fields = list(value) if isinstance(value, MatObject) else []
    return (f"name one of its fields, there is {', '.join(fields[:30])}; or " if fields else "") + SAVE_PLAIN


FORMAT = FileFormat((".mat",), read_mat, mat_channels, may_crash=True)
