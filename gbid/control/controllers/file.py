"""Controller designs and their YAML files: structure, gains, sampling, matrices and provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import TypeAdapter

from gbid._version import __version__
from gbid.control.controllers.built_in import INPUTS, NOT_OPTIONS, OUTPUTS, PerAxis, built_in_structures
from gbid.control.controllers.structures import (
    Scheduled,
    controller_at,
    controller_structure,
    scheduled,
    with_schedule,
)
from gbid.control.loop.close import Method, sample_controller
from gbid.core.arrays import Point
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, in_one_line
from gbid.core.names import given_path
from gbid.core.option_types import Positive, check_options
from gbid.core.yaml_file import YamlFile, read_yaml, write_yaml
from gbid.lpv import Domain
from gbid.lpv.model_file import FileTable, Number
from gbid.structure import LinearModel
from gbid.structure.linear import Structure
from gbid.structure.scheduling import SCHEDULING


@runtime_checkable
class Designed(Protocol):
    """Protocol of results that contain a controller design, such as `gbid.GainResult`."""

    def design(
        self, *, name: str = "", sample_time: float | None = None, method: Method | None = None, plant: str = ""
    ) -> ControllerDesign:
        """Return the controller design with its sampling."""
        ...


@dataclass(frozen=True, eq=False)
class ControllerDesign(Brief):
    """Controller with structure, gains, sampling and provenance, as `load_controller` returns it.

    Parameters
    ----------
    name : str
        Name of the design.
    structure : Structure or Scheduled, optional
        Structure of the controller. None for a user-defined structure that was not given when the file was read.
    gains : dict of str to float
        Gains, or coefficients of scheduled gains.
    sample_time : float, optional
        Sample time T_s of the sampled controller [s]; None for a continuous one, which no file and no target takes.
    method : {"tustin", "zoh"}
        Method of discretisation.
    units : dict of str to str
        Unit of each gain.
    plant : str
        Name of the model for which it was designed.
    provenance : dict of str to str or float
        Additional information, such as limits, value reached, program and date.
    models : dict of points such as (pressure_bar, speed_rpm), or None, to LinearModel
        Stored continuous models: one under None, or one per operating point of a scheduled controller.
    notes : tuple of str
        What a user should know about the file from which it was loaded: that it was changed by hand.
    variables : tuple of str
        Names of the scheduling variables; those of a scheduled structure.

    Raises
    ------
    UsageError
        When the sample time is not positive, or when the method is unknown.
    """

    name: str
    structure: Structure | Scheduled | None
    gains: Mapping[str, float]
    sample_time: Positive | None = None
    method: Method = "tustin"
    units: Mapping[str, str] = field(default_factory=dict)
    plant: str = ""
    provenance: Mapping[str, str | float] = field(default_factory=dict)
    models: Mapping[Point | None, LinearModel] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    variables: tuple[str, ...] = SCHEDULING

    def __post_init__(self) -> None:
        check_options(self, f"controller {self.name!r}")
        if isinstance(self.structure, Scheduled):
            object.__setattr__(self, "variables", self.structure.domain.variables)

    def at(self, *point: float | None, **variables: float | None) -> LinearModel:
        """Return the continuous controller.

        Parameters
        ----------
        *point, **variables : float, optional
            Scheduling variables in order or by name, such as pressure_bar [bar] and speed_rpm [rpm]; required for a
            scheduled controller, ignored by others.

        Returns
        -------
        LinearModel

        Raises
        ------
        UsageError
            When a scheduled controller gets no point, a point outside its domain, or, without its structure, a point
            that is not stored.
        """
        if unknown := [name for name in variables if name not in self.variables[len(point) :]]:
            raise UsageError(f"controller {self.name!r}: {unknown[0]} given; give {', '.join(self.variables)}")
        place = (*point, *(variables[name] for name in self.variables if name in variables))
        known = tuple(float(value) for value in place if value is not None)
        key = known if known and len(known) == len(place) else None
        if self.structure is None:
            for each in (key, None):
                if each in self.models:
                    return self.models[each]
            raise UsageError(
                f"controller {self.name!r}: no model is stored for operating point {key}; give its structure: "
                "load_controller(path, structure=...)"
            )
        if key is None and isinstance(self.structure, Scheduled):
            what = " and ".join(self.variables)
            raise UsageError(f"controller {self.name!r}: its gains follow the operating point; give {what}")
        return controller_at(self.structure, self.gains, *(key or ()))

    def sampled_at(self, *point: float | None, **variables: float | None) -> LinearModel:
        """Return the controller discretised by the method and at the sample time of the design; arguments as for `at`.

        Parameters
        ----------
        *point, **variables : float, optional
            As for `at`.
        """
        return sample_controller(self.at(*point, **variables), self.rate, self.method)

    @property
    def rate(self) -> float:
        """Sample time of the target [s]; raises an error if the design has none."""
        if self.sample_time is None:
            text = f"controller {self.name!r}: give sample_time=, the time between samples of the target in seconds"
            raise UsageError(text)
        return self.sample_time


# ---- Schema of a controller file.

SCHEMA_VERSION: Literal[1] = 1
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
    options: dict[str, Any] | None = None


@dataclass(frozen=True)
class ScheduleTable(FileTable):
    """Terms of scheduled gains, and the ranges of the scheduling variables: of pressure and speed, or in `ranges`."""

    terms: tuple[str, ...]
    pressure_bar: tuple[Number, Number] | None = None
    speed_rpm: tuple[Number, Number] | None = None
    ranges: dict[str, tuple[Number, Number]] | None = None

    @classmethod
    def of(cls, structure: Scheduled) -> ScheduleTable:
        """Return the table of a scheduled controller."""
        ranges = structure.domain.ranges
        if structure.domain.variables == SCHEDULING:
            return cls(structure.terms, ranges["pressure_bar"], ranges["speed_rpm"])
        return cls(structure.terms, ranges=ranges)

    @property
    def domain(self) -> Domain:
        """Scheduling variables with their ranges."""
        pair = {"pressure_bar": self.pressure_bar, "speed_rpm": self.speed_rpm}
        ranges = self.ranges or {name: each for name, each in pair.items() if each is not None}
        if not self.ranges and len(ranges) < len(pair):
            raise UsageError("schedule: give pressure_bar and speed_rpm, or the ranges of other variables as ranges")
        return Domain(*ranges.values(), variables=tuple(ranges))


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

    @classmethod
    def of(cls, model: LinearModel) -> MatricesTable:
        """Return the matrices of a model."""
        return cls(*(tuple(map(tuple, getattr(model, letter).tolist())) for letter in "ABCD"))


@dataclass(frozen=True)
class ControllerModelTable(FileTable):
    """Matrices of the controller; for scheduled gains at one operating point."""

    pressure_bar: Number | None = None
    speed_rpm: Number | None = None
    at: dict[str, Number] | None = None
    continuous: MatricesTable = field(kw_only=True)
    sampled: MatricesTable = field(kw_only=True)

    @property
    def point(self) -> Point | None:
        """Operating point; None for constant gains."""
        if self.at is not None:
            return tuple(self.at.values())
        return None if self.pressure_bar is None or self.speed_rpm is None else (self.pressure_bar, self.speed_rpm)


@dataclass(frozen=True, kw_only=True)
class ControllerFile(FileTable):
    """Contents of a controller file, in the order of the file."""

    kind: Literal["controller"]
    schema_version: Literal[1]
    name: str
    creator: str = ""
    loop: str = ""
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS
    plant: str = ""
    structure: StructureTable
    schedule: ScheduleTable | None = None
    gains: dict[str, GainTable]
    sampling: SamplingTable
    provenance: dict[str, str | Number] = field(default_factory=dict)
    models: tuple[ControllerModelTable, ...]


# ---- Controller files in YAML, for the real-time target and for later use.


def save_controller(
    path: str | Path,
    controller: Designed | Structure | Scheduled | str,
    gains: Mapping[str, float] | None = None,
    *,
    name: str = "",
    sample_time: float | None = None,
    method: Method | None = None,
    plant: str = "",
    points: Sequence[Point] = (),
    provenance: Mapping[str, str | float] | None = None,
    overwrite: bool = False,
) -> ControllerDesign:
    """Write a controller as a YAML file, and return the design.

    The file has the structure, the gains with units, the sampling and the matrices.

    Parameters
    ----------
    path : str or path
        The new file, ending in .yaml.
    controller : GainResult, Structure, Scheduled or str
        Result of `gbid.tune`, with its gains and its sampling; or a structure, see `controller_structure`.
    gains : dict of str to float, optional
        A value for every parameter of the structure; those of a result are its own.
    name : str
        Name of the design; by default that of the structure.
    sample_time : float, optional
        Sample time T_s of the target [s]; that of a result that was designed for a sampled loop is its own.
    method : {"tustin", "zoh"}, optional
        Method of discretisation; see `gbid.control.sample_controller`. By default that of the result, or ``"tustin"``.
    plant : str
        Name of the model for which it was designed.
    points : sequence of (pressure_bar, speed_rpm), or of other scheduling variables
        Operating points whose matrices are written; required for a scheduled controller, by default those of a result.
    provenance : dict of str to str or float, optional
        Additional information to store.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    ControllerDesign
        The design as written.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when it has another ending, when gains do not fit, when nobody
        said the sample time, when a result was designed for another one or is unstable, or when `points` are missing
        for a scheduled controller or given for another one.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a controller file ends in .yaml")
    if isinstance(controller, Designed):
        if gains is not None:
            raise UsageError(
                "save_controller: a result contains its gains; to save other gains, give the structure in its place"
            )
        design = controller.design(name=name, sample_time=sample_time, method=method, plant=plant)
        design = replace(design, provenance={**design.provenance, **(provenance or {})})
        points = points or [point for point in design.models if point is not None]
    else:
        given = controller if isinstance(controller, Scheduled) else with_schedule(controller_structure(controller))
        if gains is None:
            raise UsageError(f"controller {given.name!r}: give its gains, or the result of gbid.tune")
        design = ControllerDesign(
            name or given.name,
            given,
            {key: float(value) for key, value in gains.items()},
            sample_time,
            method or "tustin",
            {parameter.name: parameter.unit for parameter in given.parameters},
            plant,
            dict(provenance or {}),
        )
    structure = design.structure
    assert structure is not None
    if isinstance(structure, Scheduled) != bool(points):
        raise UsageError(
            f"controller {structure.name!r}: "
            + (
                "its gains do not depend on the operating point; leave points= out"
                if points
                else "give the operating points= to be written"
            )
        )
    keys: list[Point | None] = [tuple(map(float, point)) for point in points] or [None]
    design = replace(design, models={key: design.at(*(key or ())) for key in keys})
    with atomic_path(path, overwrite) as part:
        contents = TypeAdapter(ControllerFile).dump_python(_contents(design, structure), mode="json", exclude_none=True)
        write_yaml({key: value for key, value in contents.items() if value not in ("", {})}, part)
    return design


def load_controller(path: str | Path, structure: Structure | Scheduled | None = None) -> ControllerDesign:
    """Return the design stored in a controller file.

    Parameters
    ----------
    path : str or path
        The file.
    structure : Structure or Scheduled, optional
        Structure of a user-defined controller. Without it, only the stored matrices are available.

    Returns
    -------
    ControllerDesign
        The design. Its notes say when the file was changed by hand after gbid wrote it. Its matrices are then computed
        from the gains and the sampling in the file.

    Raises
    ------
    UsageError
        When the file is missing or faulty (with line and column). Also when its matrices do not agree with its gains
        in a file without checksum, or without the structure that gives the matrices.
    """
    file = read_yaml(given_path(path))
    table = ControllerFile.read(file)
    try:
        built = _structure(table, structure)
        design = ControllerDesign(
            table.name,
            built,
            {key: gain.value for key, gain in table.gains.items()},
            table.sampling.sample_time_s,
            table.sampling.method,
            {key: gain.unit for key, gain in table.gains.items()},
            table.plant,
            table.provenance,
            {model.point: _model(table, model.continuous) for model in table.models},
            file.notes,
            tuple(table.models[0].at or SCHEDULING) if table.models else SCHEDULING,
        )
        differences = [_difference(file, design, i, table) for i in range(len(table.models))]
    except UsageError as error:
        raise UsageError(str(error) if str(error).startswith(str(file.path)) else f"{file.path}: {error}") from None
    return _from_gains(design, [text for text in differences if text])


def _from_gains(design: ControllerDesign, differences: Sequence[str]) -> ControllerDesign:
    """Return a design with matrices computed from its gains if the file was changed by hand; else check both."""
    if not design.notes:
        if differences:
            raise UsageError(f"{differences[0]}; write the file anew with save_controller")
        return design
    if design.structure is None:
        if differences:
            raise UsageError(f"{differences[0]}; give its structure: load_controller(path, structure=...)")
        return replace(design, notes=(f"{design.notes[0]}; its matrices are used as they are stored",))
    models = {point: design.at(*(point or ())) for point in design.models}
    note = f"{design.notes[0]}; its matrices are computed from the gains and the sampling in the file"
    return replace(design, models=models, notes=(note, *differences[:1]))


def _contents(design: ControllerDesign, structure: Structure | Scheduled) -> ControllerFile:
    base = structure.base if isinstance(structure, Scheduled) else structure
    built_in = next((kind for kind, cls in built_in_structures().items() if type(base) is cls), None)
    options = None
    if isinstance(base, PerAxis) and built_in:
        options = {each.name: getattr(base, each.name) for each in fields(base) if each.name not in NOT_OPTIONS}
    return ControllerFile(
        kind="controller",
        schema_version=SCHEMA_VERSION,
        name=design.name,
        creator=f"gbid {__version__}",
        loop=LOOP,
        inputs=next(iter(design.models.values())).input_names,
        outputs=next(iter(design.models.values())).output_names,
        plant=design.plant,
        structure=StructureTable(built_in or "own", base.name, options),
        schedule=ScheduleTable.of(structure) if isinstance(structure, Scheduled) else None,
        gains={key: GainTable(value, design.units[key]) for key, value in design.gains.items()},
        sampling=SamplingTable(design.rate, design.method),
        provenance=dict(design.provenance),
        models=tuple(
            ControllerModelTable(
                **_place(design.variables, point),
                continuous=MatricesTable.of(model),
                sampled=MatricesTable.of(design.sampled_at(*(point or ()))),
            )
            for point, model in design.models.items()
        ),
    )


def _place(variables: tuple[str, ...], point: Point | None) -> dict[str, Any]:
    """Return the operating point of stored matrices as keys of their table."""
    if point is None:
        return {}
    values = dict(zip(variables, point, strict=True))
    return values if variables == SCHEDULING else {"at": values}


def _model(table: ControllerFile, matrices: MatricesTable, dt: float | None = None) -> LinearModel:
    n, n_p, n_r = len(matrices.A), len(table.inputs), len(table.outputs)
    shapes = {"A": (n, n), "B": (n, n_p), "C": (n_r, n), "D": (n_r, n_p)}
    parts = {}
    for letter, (height, width) in shapes.items():
        rows = getattr(matrices, letter)
        if len(rows) != height or any(len(row) != width for row in rows):
            raise UsageError(f"matrix {letter} of the controller is not ({height}, {width})")
        parts[letter] = np.array(rows, float).reshape(height, width)
    A, B, C, D = parts.values()
    return LinearModel(A, B, C, D, dt=dt, input_names=table.inputs, output_names=table.outputs, name=table.name)


def _structure(table: ControllerFile, given: Structure | Scheduled | None) -> Structure | Scheduled | None:
    if table.structure.kind == "own":
        if given is not None and given.name != table.structure.name and not isinstance(given, Scheduled):
            raise UsageError(f"its structure is {table.structure.name!r}, not {given.name!r}")
        return given
    if given is not None:
        raise UsageError(f"its structure is the built-in {table.structure.kind!r}; leave structure= out")
    options = {k: tuple(v) if isinstance(v, list) else v for k, v in (table.structure.options or {}).items()}
    try:
        base = controller_structure(table.structure.kind, **options)
    except (TypeError, ValueError, ArithmeticError) as error:  # an option of another type
        if isinstance(error, UsageError):
            raise
        problem = f"the options of its structure {table.structure.kind!r} do not fit: {in_one_line(error)}"
        raise UsageError(f"{problem}; write them as save_controller does") from None
    if table.schedule is None:
        return base
    return scheduled(base, table.schedule.terms, table.schedule.domain)


def _difference(file: YamlFile, design: ControllerDesign, i: int, table: ControllerFile) -> str:
    """Return a text on the first stored matrix that differs from gains and sampling; empty without a difference."""
    stored = table.models[i]
    point = stored.point or ()
    for what, given, expected in (
        ("continuous", design.models[stored.point], design.at(*point)),
        ("sampled", _model(table, stored.sampled, design.rate), design.sampled_at(*point)),
    ):
        for letter in "ABCD":
            matrix, computed = getattr(given, letter), getattr(expected, letter)
            scale = float(np.abs(computed).max()) if computed.size else 0.0
            if matrix.shape != computed.shape or not np.allclose(matrix, computed, rtol=1e-9, atol=1e-9 * scale):
                where = file.position(("models", i, what, letter))
                return f"{where}: {what} {letter} differs from the value computed from gains and sampling"
    return ""
