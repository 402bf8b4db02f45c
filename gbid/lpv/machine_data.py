"""Data of a machine in a model file besides the coefficients: values with unit and source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import AllowInfNan, ConfigDict, Field, Strict

from gbid.units import conversion_factor

Number = Annotated[float, Strict(), AllowInfNan(False)]
"""A finite number; text and booleans are refused when a file is read."""


class FileTable:
    """Base class of values that are read from a file; unknown keys are refused."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class Quantity(FileTable):
    """Physical value as printed in its source.

    Attributes
    ----------
    value : float
        Number in `unit`.
    unit : str
        Unit as pint reads it.
    source : str
        Place in the publication.
    """

    value: Number
    unit: str
    source: str = ""

    def to(self, unit: str) -> float:
        """Return the value in another unit.

        Parameters
        ----------
        unit : str
            Unit as pint reads it.

        Raises
        ------
        UsageError
            When the units measure different quantities.
        """
        return self.value * conversion_factor(self.unit, unit)


@dataclass(frozen=True)
class Correction(FileTable):
    """Correction of one wrong entry of a published table.

    Parameters
    ----------
    entry : str
        ``name[term]`` for a coefficient, ``scale[letter]`` for a unit, or the name of an actuator parameter.
    printed, corrected : float
        Printed value and value that is used.
    reason : str
        Evidence for the error.
    """

    entry: str
    printed: Number
    corrected: Number
    reason: Annotated[str, Field(min_length=1)]


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
    """Modes that a source gives for one operating point.

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
    """PD controllers of the piezos 1 to n, with the units as printed."""

    unit: dict[str, str]
    piezos: tuple[PiezoController, ...]
    source: str = ""
