"""Model description of a unit: the XML file of FMI 2.0 with its variables, units and abilities."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from math import pi
from typing import Literal

from gbid._version import __version__
from gbid.lpv import Domain, LPVModel
from gbid.naming.escape import one_line

Causality = Literal["input", "output", "parameter"]

_UNITS: dict[str, dict[str, str]] = {
    "m": {"m": "1"},
    "bar": {"kg": "1", "m": "-1", "s": "-2", "factor": "1e5"},
    "rpm": {"rad": "1", "s": "-1", "factor": repr(2 * pi / 60)},
    "N/kg": {"m": "1", "s": "-2"},
}


@dataclass(frozen=True)
class UnitVariable:
    """Variable of a unit.

    Attributes
    ----------
    name, causality, unit, text : str
        Name, causality, unit and description.
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


def unit_variables(domain: Domain, in_loop: bool, limit_m: float) -> list[UnitVariable]:
    """Return the variables in the order of their value references, the Boolean last.

    Parameters
    ----------
    domain : Domain
        Range of pressure and speed.
    in_loop : bool
        Whether the unit has a controller.
    limit_m : float
        Limit of the references [m].
    """
    letter, what = (
        ("w", "added to the reference of the controller") if in_loop else ("r", "position reference of the piezos")
    )
    variables = [
        UnitVariable(
            "pressure_bar", "input", "bar", "injection pressure", sum(domain.pressure_bar) / 2, *domain.pressure_bar
        ),
        UnitVariable("speed_rpm", "input", "rpm", "rotational speed", domain.speed_rpm[0], *domain.speed_rpm),
        *(UnitVariable(f"{letter}_{axis}", "input", "m", what, 0.0) for axis in "xy"),
        *(UnitVariable(f"f_{axis}", "input", "N/kg", "force on the disc per modal mass", 0.0) for axis in "xy"),
        *(UnitVariable(f"p_{axis}", "output", "m", "position of the disc") for axis in "xy"),
        *(UnitVariable(f"u_{axis}", "output", "m", "difference of the piezo positions") for axis in "xy"),
    ]
    if in_loop:
        variables += [UnitVariable(f"r_{axis}", "output", "m", "reference at the last sample") for axis in "xy"]
        variables.append(UnitVariable("limit", "parameter", "m", "largest magnitude of a reference", limit_m, 0.0))
    variables.append(
        UnitVariable(
            "extrapolate", "parameter", "", "whether pressure and speed may leave the domain of the model", False
        )
    )
    return variables


def model_description(
    identifier: str,
    model: LPVModel,
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
    model : LPVModel
        The plant.
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
        modelName=one_line(f"{model.name} {identifier}" if model.name != identifier else identifier),
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
    for name in sources:
        ET.SubElement(files, "File", name=name)
    units = ET.SubElement(root, "UnitDefinitions")
    for name, base in _UNITS.items():
        ET.SubElement(ET.SubElement(units, "Unit", name=name), "BaseUnit", base)
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
    attributes = {"name": variable.name, "valueReference": str(reference), "description": variable.text}
    attributes |= {"causality": variable.causality, "variability": kind} | ({"initial": initial} if initial else {})
    element = ET.SubElement(listed, "ScalarVariable", attributes)
    if isinstance(variable.start, bool):
        ET.SubElement(element, "Boolean", start=str(variable.start).lower())
        return
    numbers = {"start": variable.start, "min": variable.low, "max": variable.high}
    given = {key: repr(float(value)) for key, value in numbers.items() if value is not None}
    ET.SubElement(element, "Real", {"unit": variable.unit, **given})
