"""Co-simulation unit (FMI 2.0) of the plant over pressure and speed, or of the whole loop, as one file."""

from __future__ import annotations

import platform
import zipfile
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from gbid._version import __version__
from gbid.atomic import atomic_path, scratch_folder
from gbid.compiling import CompilerMissingError, compile_shared
from gbid.control import ControllerDesign
from gbid.control.controllers.scheduled import Scheduled
from gbid.cosimulation.equations import Delay, UnitEquations, unit_equations
from gbid.cosimulation.model_description import UnitVariable, model_description, unit_variables
from gbid.errors import UsageError
from gbid.lpv import Domain, LPVModel
from gbid.naming.paths import given_path

HISTORY = 1024
"""Number of references that a unit remembers for its delays."""
ORDER = 22
"""Order of the Taylor series over a piece, in which the fastest pole moves by less than one radian: 1/22! = 1e-21."""
_PLATFORMS = {"Linux": ("linux64", ".so"), "Darwin": ("darwin64", ".dylib"), "Windows": ("win64", ".dll")}
_FLAGS = ("-O2", "-std=c99", "-fPIC", "-shared", "-fvisibility=hidden", "-w")  # -w: of the functions CasADi adds unused
_DATE = (1980, 1, 1, 0, 0, 0)  # equal contents give equal files


def save_fmu(
    model: LPVModel,
    path: str | Path,
    *,
    controller: ControllerDesign | None = None,
    delay: Delay = "exact",
    pade_order: int | None = None,
    limit_m: float = 22.5e-6,
    computation_s: float | None = None,
    binary: bool = True,
    overwrite: bool = False,
) -> Path:
    """Write the plant, or the loop with a controller, as a co-simulation unit (FMU), and return the path of the file.

    Inputs are pressure [bar], speed [rpm], references r [m] (with a controller: w, added to its references) and a force
    per mass on the disc [N/kg]. Outputs are the positions p of the disc and u of the piezos [m], with a controller also
    its references r. Inputs are held between communication points; pressure and speed may change at each.

    Parameters
    ----------
    model : LPVModel
        The plant, with actuators.
    path : str or path
        The new file, ending in .fmu. Its name without the ending must be a C identifier.
    controller : ControllerDesign, optional
        Controller, as `load_controller` returns it. It is sampled with its own sample time within the unit.
    delay : {"exact", "pade"}
        Exact delays of the bearing, or their Pade approximations as in `LPVModel.plant_at`.
    pade_order : int, optional
        Order of the approximation; by default that of the model.
    limit_m : float
        Limit of the magnitude of each reference of the controller [m]; a parameter of the unit.
    computation_s : float, optional
        Time from a sample of p to the change of r [s]; one sample of the controller when not given.
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
        When the file exists and `overwrite` is not set, when its name does not fit, when the model has no actuators,
        when a number is not positive, or when there is no C compiler.
    DataError
        When the file cannot be written.

    Notes
    -----
    Between communication points all inputs are constant. The unit integrates the states exactly by Taylor series over
    pieces that end where a delayed reference changes, so that its steps need not fit the delays. FMI 2.0.4: modelica
    association, Functional Mock-up Interface for Model Exchange and Co-Simulation.
    """
    path = given_path(path)
    identifier = path.stem
    if path.suffix != ".fmu" or not (identifier.isidentifier() and identifier.isascii()):
        raise UsageError(f"{path}: give a file whose name is a C identifier and ends in .fmu")
    if delay not in ("exact", "pade"):
        raise UsageError(f"{path}: delay = {delay!r}; choose 'exact' or 'pade'")
    sample_time = None if controller is None else controller.sample_time
    computation = sample_time if computation_s is None else computation_s
    for name, value in (("limit_m", limit_m), ("computation_s", computation)):
        if value is not None and not (isfinite(value) and (value > 0 or (value == 0 and name == "computation_s"))):
            raise UsageError(f"{path}: {name} = {value}; give a positive number")
    equations = unit_equations(model, delay, pade_order, controller)
    variables = unit_variables(_domain(path, model, controller), controller is not None, limit_m)
    sources = _sources(equations, variables, sample_time, computation)
    guid = "{" + sha256("".join(sources.values()).encode()).hexdigest()[:32] + "}"
    sources = {name: text.replace("@GUID@", guid) for name, text in sources.items()}
    about = f"{model.title or model.name}: plant over pressure and speed" + (
        f", closed by {controller.name}" if controller is not None else ""
    )
    step = 2e-4 if sample_time is None else sample_time
    description = model_description(identifier, model, variables, guid, ("unit.c",), step, about)
    files: dict[str, bytes] = {"modelDescription.xml": description}
    files |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if binary:
        folder, ending = _platform()
        files[f"binaries/{folder}/{identifier}{ending}"] = _library(path, sources)
    with atomic_path(path, overwrite) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, contents in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), contents, zipfile.ZIP_DEFLATED)
    return path


def _domain(path: Path, model: LPVModel, controller: ControllerDesign | None) -> Domain:
    """Return the range of pressure and speed in which both the plant and a scheduled controller hold."""
    if controller is None or not isinstance(controller.structure, Scheduled):
        return model.domain
    ranges = []
    for name in ("pressure_bar", "speed_rpm"):
        of_plant, of_schedule = getattr(model.domain, name), getattr(controller.structure.domain, name)
        low, high = max(of_plant[0], of_schedule[0]), min(of_plant[1], of_schedule[1])
        if low > high:
            raise UsageError(
                f"{path}: {name} of the plant is {of_plant[0]:g} to {of_plant[1]:g}, that of controller "
                f"{controller.name!r} {of_schedule[0]:g} to {of_schedule[1]:g}; give a controller of this plant"
            )
        ranges.append((low, high))
    return Domain(*ranges)


def _sources(
    equations: UnitEquations,
    variables: list[UnitVariable],
    sample_time: float | None,
    computation: float | None,
) -> dict[str, str]:
    """Return the C files by name; the GUID is still to be written into them."""
    reals = [variable for variable in variables if not isinstance(variable.start, bool)]
    values: dict[str, Any] = {
        "version": __version__,
        "guid": "@GUID@",
        "n_states": equations.n_states,
        "n_parameters": equations.parameters.size1_out(0),
        "n_lags": equations.n_lags,
        "n_controller": equations.n_controller,
        "history": HISTORY,
        "order": ORDER,
        "fastest": repr(equations.fastest),
        "parameters": equations.parameters,
        "derivative": equations.derivative,
        "outputs": equations.outputs,
        "controller": equations.controller,
        "n_reals": len(reals),
        "extrapolate_vr": len(reals),
        "start_values": [repr(float(variable.start or 0.0)) for variable in reals],
        "low": [repr(variable.low) for variable in variables[:2]],
        "high": [repr(variable.high) for variable in variables[:2]],
        "input_names": [variable.name for variable in variables if variable.causality == "input"],
        "sample_time": repr(sample_time),
        "computation": repr(computation),
    }
    templates = Environment(
        loader=PackageLoader("gbid.cosimulation"), undefined=StrictUndefined, keep_trailing_newline=True
    )
    return {
        "unit.c": templates.get_template("unit.c.j2").render(values),
        "motion.h": templates.get_template("motion.h.j2").render(values),
        "fmi2_interface.h": templates.get_template("fmi2_interface.h").render(),
        "equations.h": equations.c_source(),
    }


def _platform() -> tuple[str, str]:
    """Return the folder of the libraries of this platform in a unit, and the ending of their names."""
    system = platform.system()
    if system not in _PLATFORMS:
        raise UsageError(f"FMI 2.0 has no name for libraries of {system}; write the sources only: binary=False")
    return _PLATFORMS[system]


def _library(path: Path, sources: dict[str, str]) -> bytes:
    """Return the compiled library."""
    with scratch_folder(path) as folder:
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        try:
            compile_shared(folder / "unit.c", folder / "unit.so", _FLAGS)
        except CompilerMissingError as error:
            raise UsageError(
                f"{path}: {error}; install a C compiler (gcc, clang), or write the sources only: binary=False"
            ) from None
        return (folder / "unit.so").read_bytes()
