"""Conversion of units at the edges."""

import math

import pytest

from gbid.core.errors import UsageError
from gbid.core.units import _FACTORS, SIGNALS, conversion_factor


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
        ("m/s", "mm/ms", 1.0),
        ("percent", "", 0.01),
        ("bar", "Pa", 1e5),
    ],
)
def test_known_factors(unit, target, factor):
    assert conversion_factor(unit, target) == pytest.approx(factor, rel=1e-14)
    assert conversion_factor(target, unit) == pytest.approx(1 / factor, rel=1e-14)


def test_common_factors_are_those_of_pint():
    import pint

    registry = pint.UnitRegistry()
    assert len(_FACTORS) == 28
    for (unit, target), factor in _FACTORS.items():
        assert conversion_factor(unit, target) == factor == registry.Quantity(1.0, unit).to(target).m


def test_equal_units_need_no_registry():
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
