"""Schema of a controller file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from gbid.control.controllers.per_axis import INPUTS, OUTPUTS
from gbid.errors import UsageError
from gbid.lpv.machine_data import FileTable, Number
from gbid.yaml_file import YamlFile

SCHEMA_VERSION = 1
LOOP = "r = K p, the output is added to the plant's input as it is (positive feedback)"
Rows = tuple[tuple[Number, ...], ...]


@dataclass(frozen=True)
class GainTable(FileTable):
    """Value and unit of one gain."""

    value: Number
    unit: str = ""


@dataclass(frozen=True)
class StructureTable(FileTable):
    """Built-in structure with its options, or name of a user-defined structure."""

    kind: str
    name: str = ""
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ScheduleTable(FileTable):
    """Terms of scheduled gains, and the ranges that scale pressure and speed."""

    terms: tuple[str, ...]
    pressure_bar: tuple[Number, Number]
    speed_rpm: tuple[Number, Number]


@dataclass(frozen=True)
class SamplingTable(FileTable):
    """Sample time [s] and method of discretisation."""

    sample_time_s: Number
    method: Literal["tustin", "zoh"]


@dataclass(frozen=True)
class MatricesTable(FileTable):
    """State-space matrices, row by row."""

    A: Rows
    B: Rows
    C: Rows
    D: Rows


@dataclass(frozen=True)
class ControllerModelTable(FileTable):
    """Matrices of the controller; for scheduled gains at one operating point."""

    continuous: MatricesTable
    sampled: MatricesTable
    pressure_bar: Number | None = None
    speed_rpm: Number | None = None


@dataclass(frozen=True)
class ControllerFile(FileTable):
    """Contents of a controller file."""

    kind: Literal["controller"]
    schema_version: Literal[1]
    name: str
    structure: StructureTable
    gains: dict[str, GainTable]
    sampling: SamplingTable
    models: tuple[ControllerModelTable, ...]
    loop: str = ""
    creator: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    schedule: ScheduleTable | None = None
    plant: str = ""
    provenance: dict[str, str | Number] = field(default_factory=dict)


def parse(file: YamlFile) -> ControllerFile:
    """Return the checked contents of a controller file.

    Raises
    ------
    UsageError
        When the file has problems; one line for each, as ``file:line:col: what``.
    """
    try:
        return TypeAdapter(ControllerFile).validate_python(file.data)
    except ValidationError as error:
        raise UsageError("\n".join(_message(file, problem) for problem in error.errors())) from None


def _message(file: YamlFile, problem: Any) -> str:
    location = tuple(problem["loc"])
    name, where = ".".join(str(key) for key in location), file.position(location)
    if problem["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        return f"{where}: unknown key {name!r}; remove it or correct its spelling"
    if problem["type"] in ("missing", "missing_argument"):
        return f"{where}: {name!r} is missing; write it as save_controller does"
    return f"{where}: {name} = {problem['input']!r}: {problem['msg']}; correct it"
