"""Units: SI units of the known signals, names and grammar of units, conversion factors.

Inside gbid every number is in SI units. The two scheduling variables are the exception: they keep the units of
the field, and their names say so (``pressure_bar`` and ``speed_rpm``).
"""

from __future__ import annotations

import math
import re
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

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


# ---- Units as text: a table of names, and a grammar of products, integer powers and one division.

_Dimensions = tuple[int, ...]  # exponents of m, kg, s, A, K and of the angle, which is a quantity of its own here


class _Unit(NamedTuple):
    """Factor to SI and dimensions; `origin` is the zero of a scale such as degC in its SI unit."""

    factor: float
    dimensions: _Dimensions
    origin: float = 0.0


_M, _KG, _S, _A, _K, _ANGLE = (tuple(int(i == k) for i in range(6)) for k in range(6))
_NONE = (0,) * 6


def _of(**exponents: int) -> _Dimensions:
    return tuple(exponents.get(name, 0) for name in ("m", "kg", "s", "A", "K", "angle"))


_PER_SECOND, _TURN_RATE = _of(s=-1), _of(angle=1, s=-1)
_FORCE, _PRESSURE, _VOLTAGE = _of(kg=1, m=1, s=-2), _of(kg=1, m=-1, s=-2), _of(kg=1, m=2, s=-3, A=-1)
_TURN = 2 * math.pi
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6, "G": 1e9}
_PREFIXED = {
    "m": _Unit(1.0, _M),
    "g": _Unit(1e-3, _KG),
    "s": _Unit(1.0, _S),
    "A": _Unit(1.0, _A),
    "K": _Unit(1.0, _K),
    "rad": _Unit(1.0, _ANGLE),
    "Hz": _Unit(_TURN, _TURN_RATE),
    "N": _Unit(1.0, _FORCE),
    "Nm": _Unit(1.0, _of(kg=1, m=2, s=-2)),
    "Pa": _Unit(1.0, _PRESSURE),
    "bar": _Unit(1e5, _PRESSURE),
    "J": _Unit(1.0, _of(kg=1, m=2, s=-2)),
    "W": _Unit(1.0, _of(kg=1, m=2, s=-3)),
    "V": _Unit(1.0, _VOLTAGE),
    "Ohm": _Unit(1.0, _of(kg=1, m=2, s=-3, A=-2)),
    "C": _Unit(1.0, _of(A=1, s=1)),
    "F": _Unit(1.0, _of(kg=-1, m=-2, s=4, A=2)),
    "H": _Unit(1.0, _of(kg=1, m=2, s=-2, A=-2)),
    "T": _Unit(1.0, _of(kg=1, s=-2, A=-1)),
}
"""Units that take a prefix. Hz counts turns: as a speed it is turns a second, as 1/s it is refused."""
_RPM = _Unit(_TURN / 60, _TURN_RATE)
_WORDS = {
    **dict.fromkeys(("1", "-", "none", "dimensionless"), _Unit(1.0, _NONE)),
    **dict.fromkeys(("%", "percent", "prozent"), _Unit(1e-2, _NONE)),
    **dict.fromkeys(("metre", "meter", "metro", "mètre"), _Unit(1.0, _M)),
    **dict.fromkeys(("micron", "microns", "micra", "micras", "micrometer", "micrometre"), _Unit(1e-6, _M)),
    **dict.fromkeys(("in", "inch", "inches", "zoll"), _Unit(0.0254, _M)),
    **dict.fromkeys(("mil", "mils", "thou"), _Unit(2.54e-5, _M)),
    "ft": _Unit(0.3048, _M),
    **dict.fromkeys(("kgf", "kp"), _Unit(9.80665, _FORCE)),
    **dict.fromkeys(("sec", "secs", "second", "seconds", "sek", "sekunde", "sekunden"), _Unit(1.0, _S)),
    **dict.fromkeys(("seconde", "secondes", "secondo", "secondi", "segundo", "segundos"), _Unit(1.0, _S)),
    **dict.fromkeys(("msec", "millisecond", "milliseconds", "millisekunden"), _Unit(1e-3, _S)),
    **dict.fromkeys(("usec", "microsecond", "microseconds"), _Unit(1e-6, _S)),
    **dict.fromkeys(("min", "mn", "minute", "minutes", "minuten", "minuti", "minutos"), _Unit(60.0, _S)),
    **dict.fromkeys(("h", "hour", "hours", "std"), _Unit(3600.0, _S)),
    **dict.fromkeys(("day", "days", "tage"), _Unit(86400.0, _S)),
    **dict.fromkeys(("volt", "volts", "voltios"), _Unit(1.0, _VOLTAGE)),
    **dict.fromkeys(("amp", "amps", "ampere", "amperes"), _Unit(1.0, _A)),
    **dict.fromkeys(("newton", "newtons"), _Unit(1.0, _FORCE)),
    **dict.fromkeys(("lbf",), _Unit(4.4482216152605, _FORCE)),
    **dict.fromkeys(("barg", "bars"), _Unit(1e5, _PRESSURE)),
    **dict.fromkeys(("psi", "psig"), _Unit(6894.757293168361, _PRESSURE)),
    **dict.fromkeys(("hertz", "cps", "rps"), _Unit(_TURN, _TURN_RATE)),
    **dict.fromkeys(("rpm", "r.p.m.", "cpm", "upm", "u/min", "r/min", "1/min", "min-1", "min^-1"), _RPM),
    "krpm": _Unit(1e3 * _RPM.factor, _TURN_RATE),
    **dict.fromkeys(("rads", "radian", "radians", "radiant", "radianti", "radianes"), _Unit(1.0, _ANGLE)),
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), _Unit(math.pi / 180, _ANGLE)),
    **dict.fromkeys(("gradi", "degré", "degrés", "grado", "grados", "altgrad"), _Unit(math.pi / 180, _ANGLE)),
    **dict.fromkeys(("gon", "gradian", "gradians"), _Unit(math.pi / 200, _ANGLE)),
    **dict.fromkeys(("turn", "turns", "rev", "revs", "revolution", "revolutions"), _Unit(_TURN, _ANGLE)),
    **dict.fromkeys(("umdr", "umdrehung", "umdrehungen"), _Unit(_TURN, _ANGLE)),
    **dict.fromkeys(("tr", "tour", "tours", "giro", "giri", "vuelta", "vueltas"), _Unit(_TURN, _ANGLE)),
    **dict.fromkeys(("cycle", "cycles"), _Unit(_TURN, _ANGLE)),
    **dict.fromkeys(("degc", "°c", "celsius"), _Unit(1.0, _K, 273.15)),
    "l": _Unit(1e-3, _of(m=3)),
}
"""Units without prefix, in the words of loggers of several languages; letters may be capital or small."""
_EXACT = {"Grad": _WORDS["deg"], "Grd": _WORDS["deg"], "grd": _WORDS["deg"]}  # as German loggers write degrees


class _AmbiguousError(ValueError):
    """A unit name that loggers use for two units."""


_SEVERAL = {"grad": ("deg", "gon"), "grads": ("deg", "gon"), "S": ("s", "siemens")}
"""Words that loggers use in two ways, which are refused, with both readings."""
_POWER = re.compile(r"(?P<name>[^\W\d_][^\s*·/^()\d⁻⁰-⁹²³¹+-]*|[%°1-]\w*)(?:(?:\^|\*\*)?(?P<power>[-+]?\d))?")
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_PER = re.compile(r"\s+(?:per|pro|par|al|por)\s+", re.IGNORECASE)
_LONGEST = 60  # characters of a unit


def _factor_of(word: str) -> _Unit:
    """Return a unit by name, with an SI prefix where the unit allows prefixes."""
    word = word.replace("µ", "u").replace("μ", "u").replace("Ω", "Ohm")
    if word in _SEVERAL:
        raise _AmbiguousError(f"the unit may be {' or '.join(_SEVERAL[word])}: write the intended one")
    exact = _PREFIXED.get(word) or _EXACT.get(word)
    if exact is None and word[:1] in _PREFIXES and word[1:] in _PREFIXED and word not in _WORDS:
        base = _PREFIXED[word[1:]]
        exact = base._replace(factor=_PREFIXES[word[0]] * base.factor)
    unit = exact or _WORDS.get(word.rstrip(".").lower()) or _WORDS.get(word.lower())
    if unit is None:
        raise ValueError(f"{word!r} is no unit that gbid knows")
    return unit


@lru_cache(maxsize=1024)
def _parsed(text: str) -> _Unit:
    """Return the unit that a text describes.

    Raises
    ------
    ValueError
        When the text is not written as a unit, or when it may mean two of them.
    """
    if len(text) > _LONGEST:
        raise ValueError("longer than any unit")
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda raised: "^" + raised[0].translate(_RAISED), text.strip())
    if not text:
        return _Unit(1.0, _NONE)
    text = _PER.sub("/", text)
    if text.lower().replace(" ", "") in _WORDS or text in _SEVERAL:
        return _factor_of(text.replace(" ", ""))  # some have signs of the grammar: r.p.m., 1/min
    above, slash, below = text.partition("/")
    if "/" in below:
        raise ValueError("more than one '/': write the divisors in brackets")
    above, below = above.strip(), below.strip()
    if below.startswith("(") and below.endswith(")"):
        below = below[1:-1]
    elif slash and len(_products(below)) > 1:
        raise ValueError(f"may be divided by {below!r} or by its first unit alone: write brackets")
    if slash and not below:
        raise ValueError("no unit after '/'")
    powers = [(name, power) for name, power in _products(above)]
    powers += [(name, -power) for name, power in _products(below)] if slash else []
    units = [(_factor_of(name), power) for name, power in powers]
    if len(units) == 1 and units[0][1] == 1:
        return units[0][0]
    if any(unit.origin for unit, _ in units):
        raise ValueError("a unit with an offset cannot be combined with other units")
    factor = math.prod(unit.factor**power for unit, power in units)
    exponents = zip(*([power * n for n in unit.dimensions] for unit, power in units), strict=True)
    return _Unit(factor, tuple(map(sum, exponents)))


def _products(text: str) -> list[tuple[str, int]]:
    """Return the factors of a product such as ``N s^2`` or ``m*m``, as names and powers."""
    if text.startswith("(") and text.endswith(")"):
        text = text[1:-1]
    parts = []
    for part in re.split(r"\s*[*·]\s*(?!\*)(?<!\*\*)|\s+", text.replace("**", "^").strip()):
        match = _POWER.fullmatch(part)
        if match is None:
            raise ValueError(f"{part!r} is not written as a unit")
        parts.append((match["name"], int(match["power"] or 1)))
    return parts


def is_speed_unit(word: str) -> bool:
    """Return whether a text means revolutions per minute, such as ``U/min``, ``1/min``, ``giri/min``, ``r.p.m.``."""
    with suppress(ValueError):
        return math.isclose(_parsed(word).factor, _RPM.factor) and _parsed(word).dimensions == _TURN_RATE
    return False


def is_ambiguous(word: str) -> bool:
    """Return whether loggers use a unit name for several units."""
    return word.strip() in _SEVERAL


def is_unit(word: str) -> bool:
    """Return whether a text is a unit, also an ambiguous one; an empty text is dimensionless."""
    try:
        _parsed(word)
    except ValueError as error:
        return isinstance(error, _AmbiguousError)
    return True


def conversion_factor(unit: str, target: str) -> float:
    """Return the factor that converts a number in `unit` to a number in `target`.

    A unit is a product of names with integer powers, with at most one ``/``: ``"um"``, ``"N s/(kg m)"``, ``"m/s^2"``,
    ``"rad²"``. An angle is a quantity of its own. A frequency (``Hz``, ``1/min``) as a speed is a number of turns.

    Parameters
    ----------
    unit, target : str
        Units. ``""`` means dimensionless.

    Returns
    -------
    float
        The factor.

    Raises
    ------
    UsageError
        When a unit is unknown or ambiguous, when the units measure different quantities, or when the scale has an
        offset (degC).
    """
    if unit == target:
        return 1.0
    parsed = []
    for text in (unit, target):
        try:
            parsed.append(_parsed(text))
        except ValueError as error:
            raise UsageError(f"unit {unit!r} cannot be converted to {target!r}: {error}") from None
    source, wanted = parsed
    if source.origin != wanted.origin:
        raise UsageError(f"unit {unit!r} has an offset against {target!r}; convert the data first")
    turn = 1.0
    if source.dimensions == _PER_SECOND and wanted.dimensions == _TURN_RATE:
        turn = 1.0 if "rad" in target else _TURN  # 1/s of a pole is rad/s; of a speed, it is a number of turns
    elif source == _WORDS["giri"] and wanted is _RPM and unit.lower() in ("giri", "tr"):
        turn = 1.0 / 60.0  # the short form of turns a minute on displays
    elif source.dimensions != wanted.dimensions:
        raise UsageError(f"unit {unit!r} cannot be converted to {target!r}: they measure different quantities")
    factor = turn * source.factor / wanted.factor
    decimal = float(f"{factor:.12g}")  # 1e-06, not 9.999999999999999e-07
    return decimal if math.isclose(factor, decimal, rel_tol=1e-15) else factor
