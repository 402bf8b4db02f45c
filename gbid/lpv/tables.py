"""What a model file tells about a machine beside its coefficients: values with unit and source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import AllowInfNan, ConfigDict, Field, Strict

from gbid.units import conversion_factor

Number = Annotated[float, Strict(), AllowInfNan(False)]
"""A finite number; text and booleans are refused when a file is read."""


class FileTable:
    """What is read from a file with its keys checked: unknown ones are refused."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class Quantity(FileTable):
    """One physical value as its source prints it.

    Attributes
    ----------
    value : float
        In `unit`.
    unit : str
        As pint reads it.
    source : str
        Where it stands.
    """

    value: Number
    unit: str
    source: str = ""

    def to(self, unit: str) -> float:
        """Return the value in another unit, as pint writes it.

        Parameters
        ----------
        unit : str

        Raises
        ------
        UsageError
            When the units do not measure the same thing.
        """
        return self.value * conversion_factor(self.unit, unit)


@dataclass(frozen=True)
class Correction(FileTable):
    """One faulty entry of a published table.

    Parameters
    ----------
    entry : str
        ``name[term]`` for a coefficient, ``scale[letter]`` for a unit, or the name of an actuator parameter.
    printed, corrected : float
        What the table says and what is used.
    reason : str
        How the fault is known.
    """

    entry: str
    printed: Number
    corrected: Number
    reason: Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class ProportionalDesign(FileTable):
    """A decentralised P controller with low-pass (Eq. 21); see `gbid.control.p_controller`.

    Attributes
    ----------
    kappa_x, kappa_y : float
        Gains [m/m].
    lowpass_hz : float
        Corner of the low-pass [Hz].
    lowpass_order : int
    source : str
        Where it stands.
    """

    kappa_x: Number
    kappa_y: Number
    lowpass_hz: Number = 1000.0
    lowpass_order: Annotated[int, Strict(), Field(ge=0)] = 1
    source: str = ""


@dataclass(frozen=True)
class ReferenceModes(FileTable):
    """Modes that a source gives for one operating point, as (natural frequency [Hz], damping factor).

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point.
    loop : {"open", "closed"}
    kind : {"expected", "measured"}
        From the source's model, or from its recordings.
    modes : tuple of (float, float)
        Natural frequency [Hz] and damping factor.
    source : str
        Where it stands.
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
