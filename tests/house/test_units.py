"""Conversion of units at the edges."""

import math

import pytest

from gbid.core.errors import UsageError
from gbid.core.units import SIGNALS, conversion_factor


@pytest.mark.parametrize(
    ("unit", "target", "factor"),
    [
        ("um", "m", 1e-6),
        ("µm", "m", 1e-6),
        ("mm", "m", 1e-3),
        ("nm", "um", 1e-3),
        ("inch", "m", 0.0254),
        ("ms", "s", 1e-3),
        ("deg", "rad", math.pi / 180),
        ("turn", "rad", 2 * math.pi),
        ("kN", "N", 1e3),
        ("kgf", "N", 9.80665),
        ("m/s", "mm/ms", 1.0),
        ("percent", "", 0.01),
        ("bar", "Pa", 1e5),
    ],
)
def test_known_factors(unit, target, factor):
    assert conversion_factor(unit, target) == pytest.approx(factor, rel=1e-14)
    assert conversion_factor(target, unit) == pytest.approx(1 / factor, rel=1e-14)


@pytest.mark.parametrize(("letter", "factor"), [("n", 1e-9), ("u", 1e-6), ("m", 1e-3), ("k", 1e3)])
@pytest.mark.parametrize("unit", ["m", "s", "N", "V", "A", "Hz", "rad"])
def test_prefixes_are_exact(letter, factor, unit):
    assert conversion_factor(letter + unit, unit) == factor


@pytest.mark.parametrize(
    "word",
    [
        "rpm",
        "RPM",
        "U/min",
        "1/min",
        "min^-1",
        "min-1",
        "min⁻¹",
        "UpM",
        "r.p.m.",
        "rev/min",
        "giri/min",
        "giri",
        "tr/min",
        "tr/mn",
        "tours/min",
        "cpm",
        "Umdrehungen/min",
        "revolutions per minute",
        "U pro min",
        "1/ min",
    ],
)
def test_turns_a_minute_in_the_words_of_loggers(word):
    assert conversion_factor(word, "rpm") == pytest.approx(1, rel=1e-15)


@pytest.mark.parametrize(
    ("unit", "target", "factor"),
    [
        ("Hz", "rpm", 60),
        ("1/s", "rpm", 60),
        ("s⁻¹", "rpm", 60),
        ("krpm", "rpm", 1000),
        ("rad/s", "rpm", 30 / math.pi),
        ("1/s", "rad/s", 1),
        ("mil", "um", 25.4),
        ("Mils", "um", 25.4),
        ("thou", "um", 25.4),
        ("Volts", "V", 1),
        ("Sec", "s", 1),
        ("Sek.", "s", 1),
        ("secondi", "s", 1),
        ("DEG", "deg", 1),
        ("Grad", "deg", 1),
        ("gradi", "deg", 1),
        ("degrés", "deg", 1),
        ("rev", "deg", 360),
        ("psi", "Pa", 6894.757293168361),
        ("barg", "bar", 1),
        ("N s/(kg m)", "N*s/(g*m)", 1e-3),
        ("m/s²", "mm/s^2", 1e3),
        ("m**2", "cm2", 1e4),
    ],
)
def test_units_of_loggers(unit, target, factor):
    assert conversion_factor(unit, target) == pytest.approx(factor, rel=1e-14)


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("grad", "may be deg or gon"),
        ("mil pp", "'pp' is no unit"),
        ("m**9**9**9**9", "not written as a unit"),
        ("N/kg m", "brackets"),
        ("m/s/s", "more than one '/'"),
        (100 * "m ", "longer than any unit"),
    ],
)
def test_what_may_be_read_in_two_ways_is_refused_with_both(unit, words):
    with pytest.raises(UsageError, match=words):
        conversion_factor(unit, "m")


def test_equal_units_need_no_table():
    assert conversion_factor("counts of my own", "counts of my own") == 1.0


@pytest.mark.parametrize(
    ("unit", "target"),
    [("V", "m"), ("umm", "m"), ("m/", "m"), ("(", "m"), ("1e3", ""), ("", "m"), ("m m", "m"), ("m", "foo")],
)
def test_what_is_no_conversion_is_refused_with_both_names(unit, target):
    with pytest.raises(UsageError) as caught:
        conversion_factor(unit, target)
    text = str(caught.value)
    assert repr(unit) in text
    assert repr(target) in text
    assert "\n" not in text


def test_offset_scales_are_refused():
    with pytest.raises(UsageError, match="offset"):
        conversion_factor("degC", "K")


def test_units_of_known_signals_are_si():
    base = {"m", "rad", "N", "V"} | {"rad^2/s^2"}
    field = {"pressure_bar": "bar", "speed_rpm": "rpm"}  # the scheduling variables keep the units of the field
    assert {kind.unit for name, kind in SIGNALS.items() if name not in field} == base
    assert all(SIGNALS[name].unit == unit for name, unit in field.items())
