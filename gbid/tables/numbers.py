"""Numbers in engineering notation: exponents in steps of three and significant digits."""

from __future__ import annotations

from math import floor, isfinite, log10

_SHOWN = {"s": (1e3, "ms"), "m": (1e6, "µm")}


def shown_unit(unit: str) -> tuple[float, str]:
    """Return factor and unit for showing a value: milliseconds for times, micrometres for lengths."""
    return _SHOWN.get(unit, (1.0, unit))


def exponent_of(value: float) -> int:
    """Return the exponent in steps of three; 0 when no exponent is needed.

    Examples
    --------
    >>> exponent_of(-633314.0), exponent_of(50.3), exponent_of(0.571), exponent_of(4.2e-6)
    (3, 0, 0, -6)
    """
    if value == 0 or not isfinite(value) or 1e-3 <= abs(value) < 1e4:
        return 0
    return 3 * floor(log10(abs(value)) / 3)


def finite_or_none(value: float) -> float | None:
    """Return a number, or None where it is not finite: JSON has no other word for a missing one."""
    return float(value) if isfinite(value) else None


def probability(p: float) -> str:
    """Return a probability as text with two digits; very small ones as an upper bound.

    Examples
    --------
    >>> probability(0.2345), probability(3e-145)
    ('p = 0.23', 'p < 1e-16')
    """
    return f"p = {p:.2g}" if p >= 1e-16 else "p < 1e-16"


def engineering(value: float | None, digits: int = 5, exponent: int | None = None) -> str:
    """Return a number as text with significant digits and an exponent in steps of three.

    Parameters
    ----------
    value : float or None
        Number; None and values that are not finite give a dash.
    digits : int
        Number of significant digits.
    exponent : int, optional
        Common exponent of the numbers in a row; by default that of the number itself.

    Returns
    -------
    str
        The number.

    Examples
    --------
    >>> engineering(-633314.2), engineering(0.57123), engineering(123.4, 2, 3)
    ('-633.31e3', '0.57123', '0.12e3')
    """
    if value is None or not isfinite(value):
        return "-"
    value = float(f"{value:.{digits - 1}e}")  # rounding may reach the next power of ten
    exponent = exponent_of(value) if exponent is None else exponent
    mantissa = value / 10.0**exponent
    if mantissa == 0:
        return "0"
    decimals = max(0, digits - 1 - floor(log10(abs(mantissa))))
    if decimals > 9:
        return f"{value:.{digits - 1}e}"
    text = f"{mantissa:.{decimals}f}"
    return f"{text}e{exponent}" if exponent else text


def file_size(count: int) -> str:
    """Return a number of bytes as text with a unit, e.g. ``"1.2 MB"``."""
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"
