"""Model files in YAML: LPV model of a machine, published controller, dimensions, modes and corrections."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AllowInfNan, ConfigDict, Field, Strict, TypeAdapter, ValidationError

from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, share_folder
from gbid.core.names import given_path
from gbid.core.units import conversion_factor
from gbid.core.yaml_file import YamlFile, read_yaml, write_yaml
from gbid.lpv.model import TERMS, Domain, LPVModel, MachineData
from gbid.structure import KEY_PARAMETERS
from gbid.structure.scheduling import HIGHEST_ORDER, SCHEDULING, Exponents, exponents_of, term_name

Number = Annotated[float, Strict(), AllowInfNan(False)]
"""A finite number; text and booleans are refused when a file is read."""


class FileTable:
    """Base of the tables of model files; unknown keys are refused."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    @classmethod
    def read(cls, file: YamlFile) -> Self:
        """Return the contents of a YAML file, checked.

        Raises
        ------
        UsageError
            When the file has problems; one line for each, as ``file:line:col: what``.
        """
        try:
            return TypeAdapter(cls).validate_python(file.data)
        except ValidationError as error:
            raise UsageError("\n".join(_problem(file, problem) for problem in error.errors())) from None


def _problem(file: YamlFile, problem: Any) -> str:
    location = tuple(problem["loc"])
    name, where = ".".join(map(str, location)), file.position(location)
    if problem["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        return f"{where}: unknown key {name!r}; remove it or correct its spelling"
    if problem["type"] in ("missing", "missing_argument"):
        return f"{where}: {name!r} is missing; add it"
    return f"{where}: {name} = {problem['input']!r}: {problem['msg']}; correct it"


@dataclass(frozen=True)
class Quantity(FileTable):
    """Physical quantity (value and unit) as printed in its source.

    Attributes
    ----------
    value : float
        Number in `unit`.
    unit : str
        Unit, as `gbid.core.units.conversion_factor` takes it.
    source : str
        Place in the publication.
    """

    value: Number
    unit: str
    source: str = ""

    def to(self, unit: str) -> float:
        """Return the value converted to another unit.

        Parameters
        ----------
        unit : str
            Unit, as `gbid.core.units.conversion_factor` takes it.

        Raises
        ------
        UsageError
            When the units measure different quantities.
        """
        return self.value * conversion_factor(self.unit, unit)


@dataclass(frozen=True)
class Correction(FileTable):
    """Correction of one erroneous entry of a published table.

    Parameters
    ----------
    entry : str
        ``name[term]`` for a coefficient, ``scale[letter]`` for a unit, or the name of an actuator parameter.
    printed, corrected : float
        Printed value and value that is used.
    reason : str
        Evidence for the error.
    alternatives : tuple of float
        Other values that the evidence does not exclude.
    """

    entry: str
    printed: Number
    corrected: Number
    reason: Annotated[str, Field(min_length=1)]
    alternatives: tuple[Number, ...] = ()


@dataclass(frozen=True)
class ProportionalDesign(FileTable):
    """Decentralised P controller with low-pass filter (Eq. 21); see `gbid.control.p_controller`.

    Attributes
    ----------
    kappa_x, kappa_y : float
        Gains [m/m].
    lowpass_hz : float
        Corner frequency of the low-pass filter [Hz].
    lowpass_order : int
        Order of the low-pass filter.
    source : str
        Place in the publication.
    """

    kappa_x: Number
    kappa_y: Number
    lowpass_hz: Number = 1000.0
    lowpass_order: Annotated[int, Strict(), Field(ge=0)] = 1
    source: str = ""


@dataclass(frozen=True)
class ReferenceModes(FileTable):
    """Published modes at one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point.
    loop : {"open", "closed"}
        Without or with the controller.
    kind : {"expected", "measured", "computed"}
        Origin of the modes: the model of the source, its recordings, or a computation.
    modes : tuple of (float, float)
        Natural frequency [Hz] and damping factor.
    source : str
        Place in the publication.
    """

    pressure_bar: Number
    speed_rpm: Number
    loop: Literal["open", "closed"]
    kind: Literal["expected", "measured", "computed"]
    modes: tuple[tuple[Number, Number], ...]
    source: str = ""


@dataclass(frozen=True)
class PiezoController(FileTable):
    """PD controller ``gain (s + zero)/(s + pole)`` of one piezo (Eq. A.1)."""

    gain: Number
    zero: Number
    pole: Number


@dataclass(frozen=True)
class PiezoControllers(FileTable):
    """PD controllers of the piezos 1 to n, in printed units."""

    unit: dict[str, str]
    piezos: tuple[PiezoController, ...]
    source: str = ""


@dataclass(frozen=True)
class PublishedMachine(Brief):
    """Published data of a machine: LPV model, controllers, dimensions and measured modes.

    Attributes
    ----------
    model : LPVModel
        LPV model of the machine, with the corrections applied.
    controller : ProportionalDesign, optional
        Controller of the machine.
    rig : dict of str to Quantity
        Dimensions and limits of the machine.
    piezo_controllers : PiezoControllers, optional
        Inner control loops of the piezos (Eq. A.1).
    reference_modes : tuple of ReferenceModes
        Modes that the source gives.
    corrections : tuple of Correction
        Corrections of the tables of the source.
    alternatives : dict of str to LPVModel
        The model with each alternative of a correction, by ``"entry = value"`` in the unit of the table; the first one
        is `model` itself. Designs can be assessed on each.
    """

    model: LPVModel
    controller: ProportionalDesign | None = None
    rig: dict[str, Quantity] = field(default_factory=dict)
    piezo_controllers: PiezoControllers | None = None
    reference_modes: tuple[ReferenceModes, ...] = ()
    corrections: tuple[Correction, ...] = ()
    alternatives: dict[str, LPVModel] = field(default_factory=dict)


SCHEMA_VERSION = 1
SI_UNITS = {"k": "N/(kg m)", "d": "N s/(kg m)", "b": "N/(kg m)", "tau": "s"}
"""Unit of each group of key parameters in a `LPVModel`."""

Range = tuple[Number, Number]
Row = Annotated[tuple[Number, ...], Field(min_length=1)]


@dataclass(frozen=True)
class KeyParameterTable(FileTable):
    """Coefficients of the terms (Eq. 16), with the unit of the first coefficient and the factor to SI."""

    terms: tuple[str, ...]
    coefficients: dict[str, Row]
    unit: dict[str, str] = field(default_factory=lambda: dict(SI_UNITS))
    scale: dict[str, Number] = field(default_factory=lambda: dict.fromkeys(SI_UNITS, 1.0))
    source: str = ""


@dataclass(frozen=True)
class ActuatorTable(FileTable):
    """Parameters of the actuators in Eq. 12."""

    p1_x: Number
    p2_x: Number
    kappa_x: Number
    p1_y: Number
    p2_y: Number
    kappa_y: Number
    source: str = ""


@dataclass(frozen=True)
class ModelFile(FileTable):
    """Contents of a model file, before corrections are applied."""

    kind: Literal["lpv_model"]
    schema_version: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    domain: Annotated[dict[str, Range], Field(min_length=1)]
    key_parameters: KeyParameterTable
    title: str = ""
    source: str = ""
    pade_order: Annotated[int, Field(ge=1, strict=True)] = 1
    operating_points: tuple[tuple[Number, ...], ...] = ()
    actuators: ActuatorTable | None = None
    controller: ProportionalDesign | None = None
    corrections: tuple[Correction, ...] = ()
    reference_modes: tuple[ReferenceModes, ...] = ()
    rig: dict[str, Quantity] = field(default_factory=dict)
    piezo_controllers: PiezoControllers | None = None


def parse(file: YamlFile) -> PublishedMachine:
    """Return the machine of a model file.

    Raises
    ------
    UsageError
        When the file has problems; one line for each, as ``file:line:col: what``.
    """
    table = ModelFile.read(file)
    exponents = _check_key_parameters(file, table)
    values, terms = _correct(file, table), table.key_parameters.terms
    try:
        model = LPVModel(
            name=table.name,
            coefficients=_coefficients(values, terms),
            domain=Domain(*table.domain.values(), variables=tuple(table.domain)),
            exponents=exponents,
            actuators={name: values[name] for name in _actuator_values(table)},
            pade_order=table.pade_order,
            operating_points=table.operating_points,
            title=table.title,
            source=table.source,
            notes=file.notes,
            machine=_machine_data(file, table.rig),
        )
    except UsageError as error:
        raise UsageError(f"{file.path}: {error}") from None
    alternatives = {
        f"{q.entry} = {value:g}": replace(model, coefficients=_coefficients(values | {q.entry: value}, terms))
        for q in table.corrections
        for value in ((q.corrected, *q.alternatives) if q.alternatives else ())
    }
    published = table.piezo_controllers, table.reference_modes, table.corrections
    return PublishedMachine(model, table.controller, table.rig, *published, alternatives)


_OF_MACHINE = {
    "moving_mass": ("moving_mass_kg", "kg"),
    "piezo_travel": ("piezo_travel_m", "m"),
    "clearance": ("clearance_m", "m"),
}
"""Entries of the table ``rig`` that a `MachineData` has: its field and unit."""


def _machine_data(file: YamlFile, rig: Mapping[str, Quantity]) -> MachineData:
    """Return the machine data in a model file."""
    known = {}
    for entry, (name, unit) in _OF_MACHINE.items():
        if entry in rig:
            try:
                known[name] = float(f"{rig[entry].to(unit):.12g}")  # 45 um, not 44.999999999999996
                MachineData(**known)
            except UsageError as error:
                raise UsageError(f"{file.position(('rig', entry))}: {error}") from None
    return MachineData(**known)


def _coefficients(values: Mapping[str, float], terms: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Return the coefficients in SI units per kg from the table entries."""
    scale = {group: values[f"scale[{group}]"] for group in SI_UNITS}
    return {key: tuple(scale[key.split("_")[0]] * values[f"{key}[{term}]"] for term in terms) for key in KEY_PARAMETERS}


def _correct(file: YamlFile, table: ModelFile) -> dict[str, float]:
    """Return all correctable entries by name, with the corrections applied."""
    key_parameters = table.key_parameters
    values: dict[str, float] = {
        f"{key}[{term}]": value
        for key, row in key_parameters.coefficients.items()
        for term, value in zip(key_parameters.terms, row, strict=True)
    }
    values |= {f"scale[{group}]": factor for group, factor in key_parameters.scale.items()}
    values |= _actuator_values(table)
    seen: set[str] = set()
    for i, correction in enumerate(table.corrections):
        entry = correction.entry
        where = file.position(("corrections", i, "entry"))
        if entry not in values:
            near = difflib.get_close_matches(entry, values, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "; write name[term], as in b_xx[P^2]"
            raise UsageError(f"{where}: no entry {entry!r} to correct{hint}")
        if entry in seen:
            raise UsageError(f"{where}: entry {entry!r} is corrected twice; keep one correction")
        if correction.printed != values[entry]:
            where = file.position(("corrections", i, "printed"))
            raise UsageError(
                f"{where}: {entry} is corrected from {correction.printed:g}, but the table has {values[entry]:g}"
            )
        seen.add(entry)
        values[entry] = correction.corrected
    return values


def _check_key_parameters(file: YamlFile, model: ModelFile) -> Exponents:
    """Return the powers of the terms; refuse other terms, missing or unknown names, and points of another length."""
    table, variables = model.key_parameters, tuple(model.domain)
    known = {term_name(powers, variables): powers for powers in exponents_of(HIGHEST_ORDER, len(variables))}
    is_bearing, where = variables == SCHEDULING, file.position(("key_parameters", "terms"))
    if is_bearing and table.terms != TERMS:
        raise UsageError(f"{where}: terms = [{', '.join(table.terms)}]; the order must be [{', '.join(TERMS)}]")
    if len(set(table.terms)) < len(table.terms) or not known.keys() >= set(table.terms):
        raise UsageError(f"{where}: terms = [{', '.join(table.terms)}]; choose from {', '.join(known)}, each once")
    for key, row in table.coefficients.items():
        if len(row) != len(table.terms):
            at = ("key_parameters", "coefficients", key)
            text = f"{'.'.join(at)} has {len(row)} numbers for {len(table.terms)} terms; give one for each term"
            raise UsageError(f"{file.position(at)}: {text}")
    for i, point in enumerate(model.operating_points):
        if len(point) != len(variables):
            text = f"{len(point)} numbers; give {', '.join(variables)}"
            raise UsageError(f"{file.position(('operating_points', i))}: {text}")
    for field_name, given, expected in (
        ("coefficients", table.coefficients, KEY_PARAMETERS),
        ("unit", table.unit, tuple(SI_UNITS)),
        ("scale", table.scale, tuple(SI_UNITS)),
    ):
        unknown = [name for name in given if name not in expected]
        missing = [name for name in expected if name not in given]
        if unknown or missing:
            where = file.position(("key_parameters", field_name, *unknown[:1]))
            problem = f"{', '.join(unknown)} unknown" if unknown else f"{', '.join(missing)} missing"
            raise UsageError(f"{where}: {field_name}: {problem}; expected {', '.join(expected)}")
    return tuple(known[term] for term in table.terms)


def _actuator_values(table: ModelFile) -> dict[str, float]:
    if table.actuators is None:
        return {}
    return {name: value for name, value in vars(table.actuators).items() if name != "source"}


def load_model(name_or_path: str | Path) -> LPVModel:
    """Return a model that comes with gbid, or a model from a file.

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
    return load_machine(name_or_path).model


def load_machine(name_or_path: str | Path) -> PublishedMachine:
    """Return the published data of a machine: model, controllers, dimensions, modes and corrections.

    Parameters
    ----------
    name_or_path : str or path
        As for `load_model`, whose errors are raised.

    Returns
    -------
    PublishedMachine

    Examples
    --------
    >>> machine = load_machine("theisen2016")
    >>> machine.controller.kappa_x, len(machine.corrections)
    (1.125, 7)
    """
    path = given_path(name_or_path)
    if path.suffix not in (".yaml", ".yml") and len(path.parts) <= 1:
        folder = share_folder("models")
        path = given_path(folder / f"{name_or_path}.yaml")
        if not path.is_file():
            names = ", ".join(sorted(file.stem for file in folder.glob("*.yaml")))
            raise UsageError(
                f"no model {str(name_or_path)!r} comes with gbid; there are: {names} (or give a path to a .yaml file)"
            )
    return parse(read_yaml(path))


def save_model(model: LPVModel, path: str | Path, overwrite: bool = False) -> None:
    """Write a model to a YAML file, from which `load_model` reads it without loss.

    Parameters
    ----------
    model : LPVModel
        The model of a gas bearing. Its coefficients are written in SI, with corrections already applied.
    path : str or path
        The new file, ending in .yaml.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when it has another ending, or when the model is one of another
        machine.
    DataError
        When the file cannot be written.
    """
    path = given_path(path)
    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a model file ends in .yaml")
    with atomic_path(path, overwrite) as part:
        write_model(model, part)


def write_model(model: LPVModel, path: Path) -> None:
    """Write a model as YAML."""
    model.need_bearing(None)
    write_yaml(_contents(model), path)


def _contents(model: LPVModel) -> dict[str, Any]:
    """Return the contents of a model file, without empty entries."""
    contents: dict[str, Any] = {
        "kind": "lpv_model",
        "schema_version": SCHEMA_VERSION,
        "name": model.name,
        "title": model.title,
        "source": model.source,
        "domain": {name: list(bounds) for name, bounds in model.domain.ranges.items()},
        "pade_order": model.pade_order,
        "operating_points": [list(point) for point in model.operating_points],
        "key_parameters": {
            "terms": list(model.terms),
            "unit": dict(SI_UNITS),
            "scale": dict.fromkeys(SI_UNITS, 1.0),
            "coefficients": {key: list(values) for key, values in model.coefficients.items()},
        },
        "actuators": dict(model.actuators),
        "rig": {
            entry: {"value": value, "unit": unit}
            for entry, (name, unit) in _OF_MACHINE.items()
            if (value := getattr(model.machine, name)) is not None
        },
    }
    return {key: value for key, value in contents.items() if value not in (None, "", [], {})}
