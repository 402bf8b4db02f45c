"""Co-simulation units (FMI 2.0): a plant, or its loop with a controller, as C with a model description."""

from __future__ import annotations

import json
import platform
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import product
from math import pi
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid._version import __version__
from gbid.control import ControllerDesign, GainResult
from gbid.control.controllers.structures import Scheduled
from gbid.control.tuning.plants import channel_places
from gbid.core.compiled import CompilerMissingError, compile_shared
from gbid.core.errors import UsageError
from gbid.core.files import atomic_path, scratch_folder
from gbid.core.names import given_path, one_line
from gbid.core.option_types import NotNegative, Positive
from gbid.export.chain import anti_windup_gain
from gbid.identify import FitResult
from gbid.lpv import Domain, LPVModel
from gbid.online.grid import table_over_domain
from gbid.structure import LinearModel, LinearStructure, Parameter, PiezoPair, Plant, RotorBearing, Values
from gbid.structure.delay import pade_matrices
from gbid.structure.linear import Matrices, Structure, symbolic_matrices

Delay = Literal["exact", "pade"]
Causality = Literal["input", "output", "parameter"]
_GRID = 9  # points along each scheduling variable at which the fastest pole is looked for
_MARGIN = 1.2  # of the bound on the poles
_SCHEDULE = {"pressure_bar": ("bar", "injection pressure"), "speed_rpm": ("rpm", "rotational speed")}


@dataclass(frozen=True)
class UnitVariable:
    """Variable of a co-simulation unit.

    Attributes
    ----------
    name, causality, unit, text : str
        Name, causality, unit (empty when it is not known) and description.
    start : float or bool, optional
        Start value; outputs have none.
    low, high : float, optional
        Range of values.
    """

    name: str
    causality: Causality
    unit: str
    text: str
    start: float | bool | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, eq=False)
class UnitPlant:
    """Plant ``xd = A x + B u + B_delayed u(t - delay)``, ``y = C x + D u``, whose parameters may be surfaces.

    Attributes
    ----------
    name, title : str
        Name of the model, and what it is.
    key : casadi.SX
        Parameters in the matrices that are surfaces, (n, 1); none of a linear model.
    matrices : Matrices
        Matrices as functions of `key`.
    inputs, outputs : tuple of UnitVariable
        Channels in the order of the matrices.
    model : LPVModel, optional
        Model with the surfaces.
    """

    name: str
    title: str
    key: ca.SX
    matrices: Matrices
    inputs: tuple[UnitVariable, ...]
    outputs: tuple[UnitVariable, ...]
    model: LPVModel | None

    @property
    def parameters(self) -> ca.Function:
        """Function from the scheduling variables to `key` and the delays (n_inputs,) [s]."""
        point = ca.SX.sym("point", 0 if self.model is None else len(self.model.scheduling))
        theta = ca.SX(0, 1)
        if self.model is not None:
            values = self.model.key_parameters(*ca.vertsplit(point))
            theta = ca.vertcat(*(ca.SX(values[name]) for name in self.model.coefficients))
        [delay] = ca.substitute([self.matrices.delay], [self.key], [theta])
        return ca.Function("plant_parameters", [point], [ca.densify(theta), ca.densify(delay)])

    @property
    def motion(self) -> tuple[ca.Function, ca.Function]:
        """Two functions: (x, u, delayed u, `key`) to the derivative of x, and (x, u) to y."""
        letters: Any = [getattr(self.matrices, name) for name in ("A", "B", "B_delayed", "C", "D")]
        key: Any = self.key
        kind: Any = ca.SX
        if not key.numel():  # MX keeps matrices of numbers as arrays in C, where SX writes a line for each entry
            letters, key, kind = [ca.sparsify(ca.DM(each)) for each in letters], ca.MX.sym("key", 0), ca.MX
        A, B, B_delayed, C, D = letters
        x, u, delayed = (kind.sym(*size) for size in zip("xud", (A.shape[0], *[B.shape[1]] * 2), strict=True))
        rate, y = A @ x + B @ u + B_delayed @ delayed, C @ x + D @ u
        return (
            ca.Function("plant_derivative", [x, u, delayed, key], [ca.densify(rate)]),
            ca.Function("plant_outputs", [x, u], [ca.densify(y)]),
        )

    @property
    def fastest(self) -> float:
        """Estimated upper bound of the pole magnitudes [1/s]: the largest on a grid over the domain, with a margin."""
        A, parameters = ca.Function("A", [self.key], [ca.densify(self.matrices.A)]), self.parameters
        bounds = () if self.model is None else self.model.domain.bounds
        points = product(*(np.linspace(*bound, _GRID) for bound in bounds))
        poles = [np.linalg.eigvals(np.array(A(parameters(list(point))[0]))) for point in points]
        return float(_MARGIN * np.abs(poles).max(initial=0.0))


def unit_plant(model: LPVModel | LinearModel | FitResult, delay: Delay, pade_order: int | None) -> UnitPlant:
    """Return the plant of a co-simulation unit from a model.

    Parameters
    ----------
    model : LPVModel, LinearModel or FitResult
        Model in continuous time; that of a gas bearing has actuators.
    delay : {"exact", "pade"}
        Exact delays, or Pade approximations.
    pade_order : int, optional
        Order of the approximation; by default that of an LPV model, of others 3.

    Raises
    ------
    UsageError
        When the model of a gas bearing has no actuators, or when a model is sampled.
    """
    model = model.linear_model if isinstance(model, FitResult) else model
    lpv = model if isinstance(model, LPVModel) else None
    default = 3 if lpv is None else lpv.pade_order
    order = None if delay == "exact" else default if pade_order is None else pade_order
    structure = _equations(model, order)
    every, matrices = symbolic_matrices(structure)
    if matrices.feedback is not None or getattr(model, "dt", None) is not None:
        raise UsageError(f"model {model.name!r} is sampled; give the plant in continuous time")
    if order is not None:
        matrices = pade_matrices(matrices, order)
    names = () if lpv is None else tuple(lpv.coefficients)
    key = ca.SX.sym("key", len(names))
    known: dict[str, Any] = {} if lpv is None else {**lpv.actuators, **lpv.held}
    known |= {name: key[i] for i, name in enumerate(names)}
    values = ca.vertcat(ca.SX(0, 1), *(ca.SX(known[parameter.name]) for parameter in structure.parameters))
    letters: list[Any] = ca.substitute(list(matrices[:8]), [ca.SX(every)], [values])
    matrices = Matrices(*letters)
    if lpv is not None and lpv.structure is None:
        return _bearing_unit(lpv, key, matrices)
    inputs = (UnitVariable(name, "input", "", "input of the model", 0.0) for name in model.input_names)
    outputs = (UnitVariable(name, "output", "", "output of the model") for name in model.output_names)
    title = model.name if lpv is None else lpv.title or lpv.name
    return UnitPlant(model.name, title, key, matrices, tuple(inputs), tuple(outputs), lpv)


def _equations(model: LPVModel | LinearModel, pade_order: int | None) -> Structure:
    """Return the equations of a model: of a gas bearing with actuators, or of a linear model without parameters."""
    if isinstance(model, LinearModel):
        given = {letter: getattr(model, letter) for letter in ("A", "B", "C", "D", "B_delayed", "delay")}
        numbers = {letter: ca.DM(np.array(value)) for letter, value in given.items() if value is not None}
        return LinearStructure(model.name, (), lambda _: numbers)
    if model.structure is not None:
        return model.structure
    if not model.actuators:
        raise UsageError(f"model {model.name!r} has no actuators; give them in its file under 'actuators'")
    return Plant(RotorBearing(pade_order, disturbance_gain="none"), PiezoPair(), outputs=("u", "p"))


def _bearing_unit(model: LPVModel, key: ca.SX, m: Matrices) -> UnitPlant:
    """Return the plant of a gas bearing with forces per mass on the rotor as further inputs."""
    entry = ca.SX(m.A.shape[0], 2)
    selected = np.array(ca.DM(m.C))
    for axis in range(2):
        entry[int(np.flatnonzero(selected[2 + axis])[0]) + 2, axis] = 1.0
    matrices = m._replace(
        B=ca.horzcat(m.B, entry),
        B_delayed=ca.horzcat(m.B_delayed, ca.SX(*entry.shape)),
        C=m.C[[2, 3, 0, 1], :],
        D=ca.SX(4, 4),
        delay=ca.vertcat(m.delay, ca.SX(2, 1)) if m.has_delay else m.delay,
    )

    def pair(letter: str, causality: Causality, unit: str, text: str, start: float | None) -> list[UnitVariable]:
        return [UnitVariable(f"{letter}_{axis}", causality, unit, text, start) for axis in "xy"]

    inputs = pair("r", "input", "m", "position reference of the piezos", 0.0)
    inputs += pair("f", "input", "N/kg", "force on the disc per modal mass", 0.0)
    outputs = pair("p", "output", "m", "position of the disc", None)
    outputs += pair("u", "output", "m", "difference of the piezo positions", None)
    return UnitPlant(model.name, model.title or model.name, key, matrices, tuple(inputs), tuple(outputs), model)


@dataclass(frozen=True, eq=False)
class UnitController:
    """Sampled controller of a co-simulation unit.

    Attributes
    ----------
    step : casadi.Function
        (scheduling variables, states, measured outputs) -> (commands, states at the next sample without limits,
        anti-windup gain).
    driven, measured : tuple of int
        Inputs of the plant that it commands, and outputs that it measures.
    sample_time, computation : float
        Sample time, and time from a sample to the change of the command [s].
    limits : tuple of float
        Largest magnitude of each command.
    """

    step: ca.Function
    driven: tuple[int, ...]
    measured: tuple[int, ...]
    sample_time: float
    computation: float
    limits: tuple[float, ...]


def _controller_step(design: ControllerDesign) -> ca.Function:
    """Return the function of one controller sample, with gains at the present pressure and speed if scheduled."""
    point = ca.SX.sym("point", len(design.variables) if isinstance(design.structure, Scheduled) else 0)
    if isinstance(design.structure, Scheduled):
        A, B, C, D = _tustin(design, design.structure, ca.vertsplit(point))
        L = _scheduled_gain(design, design.structure, ca.vertsplit(point)).reshape(C.T.shape)
    else:
        model = design.sampled_at()
        letters = (model.A, model.B, model.C, model.D, anti_windup_gain(model))
        A, B, C, D, L = (ca.SX(ca.DM(np.array(letter))) for letter in letters)
    x, y = ca.SX.sym("x", A.shape[0]), ca.SX.sym("y", D.shape[1])
    results = [ca.densify(each) for each in (C @ x + D @ y, A @ x + B @ y, L)]
    return ca.Function("controller_step", [point, x, y], results)


def _scheduled_gain(design: ControllerDesign, structure: Scheduled, point: list[ca.SX]) -> ca.SX:
    """Return the anti-windup gain, interpolated over the points of the schedule as in the control chain."""
    table = table_over_domain(lambda *at: anti_windup_gain(design.sampled_at(*at)).T.ravel(), structure.domain)
    weight = ca.SX(1)
    for nodes, value in zip(table.axes.values(), point, strict=True) if table.is_scheduled else ():
        inside = ca.fmin(ca.fmax(value, nodes[0]), nodes[-1])
        hats = [ca.pw_lin(inside, ca.DM(nodes), ca.DM(row)) for row in np.eye(len(nodes))]
        weight = ca.kron(weight, ca.vertcat(*hats))
    return ca.SX(ca.DM(table.rows)).T @ weight


def _tustin(design: ControllerDesign, structure: Scheduled, point: list[ca.SX]) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return the matrices of a scheduled controller by the trapezoidal rule, symbolic in pressure and speed."""
    if design.method != "tustin":
        raise UsageError(
            f"controller {design.name!r}: an FMU discretises scheduled gains by 'tustin', not by {design.method!r}; "
            "store the design with method='tustin'"
        )
    followed, gains = tuple(map(Parameter, structure.domain.variables)), Values(design.gains)
    over_point = LinearStructure(
        structure.name,
        followed,
        lambda p: structure.matrices(gains, *(p[each.name] for each in followed)),
        structure.inputs,
        structure.outputs,
    )
    every, matrices = symbolic_matrices(over_point)
    A, B, C, D = ca.substitute([matrices.A, matrices.B, matrices.C, matrices.D], [every], [ca.vertcat(*point)])
    half, eye = design.rate / 2.0, ca.SX.eye(A.shape[0])
    inverse = ca.inv(eye - half * A) if A.shape[0] else eye
    C_sampled = C @ inverse
    return inverse @ (eye + half * A), inverse @ (2.0 * half * B), C_sampled, D + half * C_sampled @ B


# ---- Model description of a unit: the XML file of FMI 2.0 with its variables, units and abilities.

_UNITS: dict[str, dict[str, str]] = {
    "m": {"m": "1"},
    "bar": {"kg": "1", "m": "-1", "s": "-2", "factor": "1e5"},
    "rpm": {"rad": "1", "s": "-1", "factor": repr(2 * pi / 60)},
    "N/kg": {"m": "1", "s": "-2"},
}


def unit_variables(plant: UnitPlant, domain: Domain | None, controller: UnitController | None) -> list[UnitVariable]:
    """Return the variables of a unit in the order of their value references; the Boolean is last.

    Raises
    ------
    UsageError
        When two variables have the same name.
    """
    ranges = {} if domain is None else domain.ranges
    variables = []
    for name, (low, high) in ranges.items():
        about = _SCHEDULE.get(name, ("", "scheduling variable"))
        variables.append(
            UnitVariable(name, "input", *about, low if name == "speed_rpm" else (low + high) / 2, low, high)
        )
    limits = {} if controller is None else dict(zip(controller.driven, controller.limits, strict=True))
    added = "added to the command of the controller"
    for i, each in enumerate(plant.inputs):
        name = "w_" + each.name.removeprefix("r_")
        variables.append(replace(each, name=name, text=added) if i in limits else each)
    command: dict[str, Any] = {"causality": "output", "start": None, "text": "command at the last sample"}
    limit: dict[str, Any] = {"causality": "parameter", "low": 0.0, "text": "largest magnitude of a command"}
    driven = [(plant.inputs[i], largest) for i, largest in limits.items()]
    variables += [*plant.outputs, *(replace(each, **command) for each, _ in driven)]
    variables += [replace(each, name=f"limit_{each.name}", start=largest, **limit) for each, largest in driven]
    if ranges:
        text = "whether scheduling variables may leave the domain of the model"
        variables.append(UnitVariable("extrapolate", "parameter", "", text, False))
    names = [each.name for each in variables]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"model {plant.name!r}: two variables {twice[0]!r}; give its channels other names")
    return variables


def model_description(
    identifier: str,
    name: str,
    variables: list[UnitVariable],
    guid: str,
    sources: tuple[str, ...],
    step: float,
    description: str,
) -> bytes:
    """Return the text of modelDescription.xml.

    Parameters
    ----------
    identifier : str
        Name of the library, a C identifier.
    name : str
        Name of the plant.
    variables : list of UnitVariable
        From `unit_variables`.
    guid : str
        Digest of the sources, which the library checks.
    sources : tuple of str
        Files to be compiled.
    step : float
        Suggested communication step [s].
    description : str
        What the unit is.
    """
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=one_line(f"{name} {identifier}" if name != identifier else identifier),
        guid=guid,
        description=one_line(description),
        generationTool=f"gbid {__version__}",
        variableNamingConvention="flat",
        numberOfEventIndicators="0",
    )
    unit = ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        canHandleVariableCommunicationStepSize="true",
        canInterpolateInputs="false",
        canBeInstantiatedOnlyOncePerProcess="false",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    files = ET.SubElement(unit, "SourceFiles")
    for file in sources:
        ET.SubElement(files, "File", name=file)
    units = ET.SubElement(root, "UnitDefinitions")
    for symbol, base in _UNITS.items():
        ET.SubElement(ET.SubElement(units, "Unit", name=symbol), "BaseUnit", base)
    log = ET.SubElement(root, "LogCategories")
    ET.SubElement(log, "Category", name="error")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(step))
    listed = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        _add_variable(listed, reference, variable)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [str(i) for i, variable in enumerate(variables, start=1) if variable.causality == "output"]
    for group in ("Outputs", "InitialUnknowns"):
        element = ET.SubElement(structure, group)
        for index in outputs:
            ET.SubElement(element, "Unknown", index=index)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _add_variable(listed: ET.Element, reference: int, variable: UnitVariable) -> None:
    kind = {"input": "continuous", "output": "continuous", "parameter": "tunable"}[variable.causality]
    initial = {"input": None, "output": "calculated", "parameter": "exact"}[variable.causality]
    attributes = {"name": one_line(variable.name), "valueReference": str(reference), "description": variable.text}
    attributes |= {"causality": variable.causality, "variability": kind} | ({"initial": initial} if initial else {})
    element = ET.SubElement(listed, "ScalarVariable", attributes)
    if isinstance(variable.start, bool):
        ET.SubElement(element, "Boolean", start=str(variable.start).lower())
        return
    numbers = {"start": variable.start, "min": variable.low, "max": variable.high}
    given = {key: repr(float(value)) for key, value in numbers.items() if value is not None}
    ET.SubElement(element, "Real", ({"unit": variable.unit} if variable.unit else {}) | given)


# ---- Co-simulation unit (FMI 2.0) of a plant, or of the whole loop, as one file.

HISTORY = 1024
"""Number of changes of an input that a unit remembers for its delay."""
ORDER = 22
"""Order of the Taylor series over a piece, in which the fastest pole moves by less than one radian: 1/22! = 1e-21."""
_PLATFORMS = {"Linux": ("linux64", ".so"), "Darwin": ("darwin64", ".dylib"), "Windows": ("win64", ".dll")}
_FLAGS = ("-O2", "-std=c99", "-fPIC", "-shared", "-fvisibility=hidden", "-w")  # -w: of the functions CasADi adds unused
_DATE = (1980, 1, 1, 0, 0, 0)  # equal contents give equal files


def save_fmu(
    model: LPVModel | LinearModel | FitResult,
    path: str | Path,
    *,
    controller: ControllerDesign | GainResult | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    delay: Delay = "exact",
    pade_order: int | None = None,
    limits: Positive | Sequence[Positive] | None = None,
    computation_s: NotNegative | None = None,
    binary: bool = True,
    overwrite: bool = False,
) -> Path:
    """Write a plant, or its loop with a controller, as a co-simulation unit (FMU), and return the path of the file.

    Inputs of the unit are the scheduling variables of an LPV model and the inputs of the plant: of a gas bearing
    references r [m] and a force per mass on the disc [N/kg]. Its outputs are those of the plant: of a gas bearing the
    positions p of the disc and u of the piezos [m]. In a loop, inputs w are added to the commands of the controller,
    which are outputs, too. Inputs are held between communication points; scheduling variables may change at each.

    Parameters
    ----------
    model : LPVModel, LinearModel or FitResult
        The plant in continuous time; that of a gas bearing has actuators.
    path : str or path
        The new file, ending in .fmu. Its name without the ending must be a C identifier.
    controller : ControllerDesign or GainResult, optional
        Controller, as `load_controller` returns it, or the result of `gbid.tune` for a sampled loop. It is sampled with
        its own sample time within the unit.
    inputs, outputs : sequence of str, optional
        Channels of the plant that the controller drives and measures, in the order of its outputs and inputs; by
        default those with the names that the controller has, else all.
    delay : {"exact", "pade"}
        Exact delays, or their Pade approximations as in `LPVModel.plant_at`.
    pade_order : int, optional
        Order of the approximation; by default that of an LPV model, of others 3.
    limits : float or sequence of float, optional
        Largest magnitude of each command of the controller, in the unit of the input, parameters of the unit; by
        default half of the travel of the piezos (`gbid.lpv.MachineData`).
    computation_s : float, optional
        Time from a sample to the change of the command [s]; one sample of the controller when not given.
    binary : bool
        Whether the library for this platform is included; the sources always are.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    UsageError
        When the file exists and `overwrite` is not set, when its name does not fit, when a gas bearing has no
        actuators, when a model is sampled, when the controller has other channels than the plant, when a number is not
        positive, when the limits of the commands are missing, or when there is no C compiler.
    DataError
        When the file cannot be written.

    Notes
    -----
    Between communication points all inputs are constant. The unit integrates the states exactly by Taylor series over
    pieces that end where a delayed input changes, so that its steps need not fit the delays. FMI 2.0.4: modelica
    association, Functional Mock-up Interface for Model Exchange and Co-Simulation.
    """
    path = given_path(path)
    identifier = path.stem
    if path.suffix != ".fmu" or not (identifier.isidentifier() and identifier.isascii()):
        raise UsageError(f"{path}: give a file whose name is a C identifier and ends in .fmu")
    if isinstance(controller, GainResult):
        controller = controller.design()
    plant = unit_plant(model, delay, pade_order)
    law = (
        None
        if controller is None
        else _unit_controller(path, plant, controller, (inputs, outputs), limits, computation_s)
    )
    variables = unit_variables(plant, _domain(path, plant, controller), law)
    sources = _sources(plant, variables, law)
    guid = "{" + sha256("".join(sources.values()).encode()).hexdigest()[:32] + "}"
    sources = {name: text.replace("@GUID@", guid) for name, text in sources.items()}
    about = f"{plant.title}: plant" + ("" if controller is None else f", closed by {controller.name}")
    step = 2e-4 if law is None else law.sample_time
    description = model_description(identifier, plant.name, variables, guid, ("unit.c",), step, about)
    files: dict[str, bytes] = {"modelDescription.xml": description}
    files |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if binary:
        system = platform.system()
        if system not in _PLATFORMS:
            raise UsageError(f"FMI 2.0 has no name for libraries of {system}; write the sources only: binary=False")
        folder, ending = _PLATFORMS[system]
        files[f"binaries/{folder}/{identifier}{ending}"] = _library(path, sources)
    with atomic_path(path, overwrite) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, contents in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), contents, zipfile.ZIP_DEFLATED)
    return path


def _unit_controller(
    path: Path,
    plant: UnitPlant,
    design: ControllerDesign,
    channels: tuple[Sequence[str] | None, Sequence[str] | None],
    limits: float | Sequence[float] | None,
    computation_s: float | None,
) -> UnitController:
    """Return the controller of a unit, connected to the channels of the plant."""
    schedule = design.structure.domain.bounds if isinstance(design.structure, Scheduled) else ()
    law = design.at(*(low for low, _ in schedule))
    places = []
    for word, own, wanted, sides in zip(
        ("input", "output"), (law.output_names, law.input_names), channels, (plant.inputs, plant.outputs), strict=True
    ):
        names = tuple(each.name for each in sides)
        wanted = own if wanted is None and set(own) <= set(names) else wanted
        places.append(tuple(channel_places(plant.name, word, names, wanted)))
        if len(places[-1]) != len(own):
            raise UsageError(
                f"controller {design.name!r} needs {len(own)} {word}s of the plant ({', '.join(own)}), {plant.name!r} "
                f"has {len(places[-1])}; choose them by inputs= and outputs="
            )
    driven, measured = places
    travel = None if plant.model is None else plant.model.machine.piezo_travel_m
    limits = limits if limits is not None or travel is None else travel / 2
    if limits is None:
        raise UsageError(
            f"{path}: limits are missing (the largest magnitude of each command); give limits=, or in an experiment "
            "the keys limits, beyond and units of its section target"
        )
    largest = np.atleast_1d(np.array(limits, float))
    if len(largest) not in (1, len(driven)):
        raise UsageError(f"{path}: {len(largest)} limits for {len(driven)} commands of controller {design.name!r}")
    computation = design.rate if computation_s is None else computation_s
    if computation == 0 and plant.matrices.D[list(measured), list(driven)].nnz():
        raise UsageError(f"{path}: computation_s = 0, but inputs act on the outputs at once; give a positive time")
    held = tuple(np.broadcast_to(largest, len(driven)).tolist())
    return UnitController(_controller_step(design), driven, measured, design.rate, computation, held)


def _domain(path: Path, plant: UnitPlant, controller: ControllerDesign | None) -> Domain | None:
    """Return the range of pressure and speed in which plant and scheduled controller are valid."""
    domain = None if plant.model is None else plant.model.domain
    if controller is None or not isinstance(controller.structure, Scheduled):
        return domain
    schedule = controller.structure.domain
    if domain is None:
        return schedule
    if domain.variables != schedule.variables:
        raise UsageError(
            f"{path}: controller {controller.name!r} follows {', '.join(schedule.variables)}, the plant "
            f"{', '.join(domain.variables)}; give a controller of this plant"
        )
    ranges = [(max(a, c), min(b, d)) for (a, b), (c, d) in zip(domain.bounds, schedule.bounds, strict=True)]
    for name, (low, high) in zip(domain.variables, ranges, strict=True):
        if low > high:
            (a, b), (c, d) = domain.ranges[name], schedule.ranges[name]
            raise UsageError(
                f"{path}: {name} of the plant is {a:g} to {b:g}, that of controller {controller.name!r} {c:g} to {d:g}"
                "; give a controller of this plant"
            )
    return Domain(*ranges, variables=domain.variables)


def _sources(plant: UnitPlant, variables: list[UnitVariable], controller: UnitController | None) -> dict[str, str]:
    """Return the C files by name, with a placeholder for the GUID."""
    reals = [variable for variable in variables if not isinstance(variable.start, bool)]
    inputs = [variable for variable in variables if variable.causality == "input"]
    schedule = inputs[: len(inputs) - len(plant.inputs)]
    derivative, outputs = plant.motion
    functions = {"parameters": plant.parameters, "derivative": derivative, "outputs": outputs}
    if controller is not None:
        functions["step"] = controller.step
    generator = ca.CodeGenerator("equations.c", {"main": False, "with_header": False, "casadi_int": "int"})
    for function in functions.values():
        generator.add(function)
    values: dict[str, Any] = {
        "version": __version__,
        "guid": "@GUID@",
        "plant": plant,
        "history": HISTORY,
        "order": ORDER,
        "controller": controller,
        "free": [i for i in range(len(plant.inputs)) if controller is None or i not in controller.driven],
        "start_values": [repr(float(variable.start or 0.0)) for variable in reals],
        "schedule": schedule,
        "input_names": [json.dumps(one_line(variable.name), ensure_ascii=False) for variable in inputs],
        **functions,
    }
    templates = Environment(loader=PackageLoader("gbid.export"), undefined=StrictUndefined, keep_trailing_newline=True)
    templates.globals["size"] = lambda count: max(count, 1)  # C has no empty arrays
    return {
        "unit.c": templates.get_template("unit.c.j2").render(values),
        "motion.h": templates.get_template("motion.h.j2").render(values),
        "fmi2_interface.h": templates.get_template("fmi2_interface.h").render(),
        "equations.h": str(generator.dump()),
    }


def _library(path: Path, sources: dict[str, str]) -> bytes:
    """Return the bytes of the compiled library."""
    with scratch_folder(path) as folder:
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        try:
            compile_shared(folder / "unit.c", folder / "unit.so", _FLAGS)
        except CompilerMissingError as error:
            raise UsageError(
                f"{path}: {error}; install a C compiler (gcc, clang or gbid[compiler]), or write the sources only: "
                "binary=False"
            ) from None
        return (folder / "unit.so").read_bytes()
