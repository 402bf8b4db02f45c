"""Known signals of the test rig with their SI units, and conversion of units.

Inside gbid every number is in SI units. The two scheduling variables are the exception: they keep the units of
the field, and their names say so (``pressure_bar`` and ``speed_rpm``).
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any, NamedTuple

from gbid.core.errors import UsageError


class SignalKind(NamedTuple):
    """Unit, description and channels of a known signal.

    Attributes
    ----------
    unit : str
        SI unit.
    long_name : str
        Description for files and axis labels.
    channels : tuple of str
        Names of the channels.
    """

    unit: str
    long_name: str
    channels: tuple[str, ...]


SIGNALS: dict[str, SignalKind] = {
    "r": SignalKind("m", "piezo position reference", ("x", "y")),
    "w": SignalKind("m", "excitation injected into the loop", ("x", "y")),
    "u": SignalKind("m", "difference of piezo positions", ("x", "y")),
    "p": SignalKind("m", "lateral disc position", ("x", "y")),
    "phi": SignalKind("rad", "shaft angle", ("phi",)),
    "pressure_bar": SignalKind("bar", "injection pressure", ("pressure_bar",)),
    "speed_rpm": SignalKind("rpm", "speed of the shaft", ("speed_rpm",)),
    "unbalance": SignalKind("rad^2/s^2", "direction of the unbalance times the square of the speed", ("x", "y")),
    "force": SignalKind("N", "impact force", ("force",)),
    "f": SignalKind("N", "impact force along the axes", ("x", "y")),
    "v": SignalKind("V", "voltage of each piezo stack", ("1", "2", "3", "4")),
    "y_p": SignalKind("m", "position of each piezo stack", ("1", "2", "3", "4")),
    "r_p": SignalKind("m", "position reference of each piezo stack", ("1", "2", "3", "4")),
}
"""The signals of the test rig (paper, Secs. 2 and 3.4)."""


IN_METRES = ("rotor_bearing", "piezo_pair", "plant")
"""Structures of gbid whose inputs and outputs are in metres."""


@cache
def _registry() -> Any:
    import pint  # imported here, because the import is slow

    return pint.UnitRegistry()


_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3}
_PREFIXED = ("m", "s", "N", "V", "A", "Hz", "rad")
_FACTORS = {(prefix + unit, unit): factor for prefix, factor in _PREFIXES.items() for unit in _PREFIXED}
"""Factors of the common units: to start pint takes half a second, longer than a fit."""


_SPEED_WORDS = {"rpm", "upm", "1min", "min1"} | {
    f"{turn}min" for turn in ("u", "r", "rev", "revs", "tr", "umdr", "umdrehungen", "revolutions", "turns")
}


def is_speed_unit(word: str) -> bool:
    """Return whether a word means turns per minute: ``U/min``, ``1/min``, ``min^-1``, ``UpM``, ``r.p.m.`` and so on.

    pint takes 1/min for an angle of one radian in a minute.
    """
    return re.sub(r"[\W_]|per|pro", "", word.lower()) in _SPEED_WORDS


def is_unit(word: str) -> bool:
    """Return whether a word is a unit as pint writes it; an empty word is dimensionless."""
    try:
        _registry().parse_units(word)
    except Exception:  # an unknown unit, and errors of the tokeniser that pint does not catch
        return False
    return True


def conversion_factor(unit: str, target: str) -> float:
    """Return the factor that converts a number in `unit` to a number in `target`.

    Parameters
    ----------
    unit, target : str
        Units as pint writes them: ``"um"``, ``"m"``, ``"deg"``, ``"V"``. ``""`` means dimensionless.

    Returns
    -------
    float
        The factor.

    Raises
    ------
    UsageError
        When a unit is unknown, when the units measure different quantities, or when the scale has an offset (degC).
    """
    if unit == target or (unit, target) in _FACTORS:
        return _FACTORS.get((unit, target), 1.0)
    import pint

    registry = _registry()
    try:
        source, wanted = unit or "dimensionless", target or "dimensionless"
        zero, factor = (registry.Quantity(number, source).to(wanted).m for number in (0.0, 1.0))
    except (pint.UndefinedUnitError, pint.DimensionalityError, pint.OffsetUnitCalculusError) as error:
        raise UsageError(f"unit {unit!r} cannot be converted to {target!r}: {error}") from None
    except Exception as error:  # pint does not catch the errors of the tokeniser
        text = f"unit {unit!r} cannot be converted to {target!r}: not written as a unit"
        raise UsageError(f"{text} ({error})" if str(error) else text) from None
    if zero != 0.0:
        raise UsageError(f"unit {unit!r} has an offset against {target!r}; convert the data first")
    return float(factor)
