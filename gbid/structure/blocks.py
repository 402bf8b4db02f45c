"""Block-oriented structures: a static nonlinearity between two linear filters (Wiener, Hammerstein, both)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import FloatArray
from gbid.core.errors import UsageError
from gbid.discretise import Hold
from gbid.structure.nonlinear import NonlinearStructure
from gbid.structure.parameter import Parameter, Values


def smooth_hinge(v: Any, width: float) -> Any:
    """Return ``max(v, 0)`` with a rounded corner, ``(v + sqrt(v^2 + width^2)) / 2``.

    Parameters
    ----------
    v : casadi.SX, float or array
        Argument.
    width : float
        Width of the corner, in the unit of `v`; the value at the corner is ``width / 2``.

    Examples
    --------
    >>> smooth_hinge(3.0, 8.0)
    4.0
    """
    return 0.5 * (v + (v**2 + width**2) ** 0.5)


def wiener_hammerstein(
    before: int,
    after: int,
    knots: npt.ArrayLike,
    frequency_hz: float,
    *,
    inputs: str = "u",
    outputs: str = "y",
    intersample: Hold = "foh",
    steps: int = 1,
    name: str = "wiener_hammerstein",
) -> NonlinearStructure:
    """Return a linear filter, a static nonlinearity and a second linear filter in series, for one input and one output.

    The nonlinearity is ``f(w) = w + sum_i f_i max(w - knot_i, 0)`` with corners as wide as the smallest distance of the
    knots: a spline, straight outside. Each filter has as many zeros as poles. The first has the static gain 1, and `f`
    the slope 1 left of the knots, so that each parameter is determined. With all ``f_i = 0``, the start values, the
    structure is linear.

    Parameters
    ----------
    before, after : int
        Orders of the filters; 0 for none: a Hammerstein structure has no filter before, a Wiener structure none after.
    knots : (n,) array
        Knots of the nonlinearity, increasing, in the unit of the input.
    frequency_hz : float
        Frequency by which the coefficients of the filters are scaled. They begin as Butterworth filters of it.
    inputs, outputs : str
        Channels of the recordings.
    intersample : {"zoh", "foh"}
        Inter-sample behaviour of the input.
    steps : int
        Steps of the integrator in a sample.
    name : str
        Name of the structure.

    Returns
    -------
    NonlinearStructure
        Parameters ``a_i`` and ``b_i`` of the filter before, ``c_i`` and ``d_i`` of that after (denominator and
        numerator, ascending powers of ``s / (2 pi frequency_hz)``), ``f_i`` of the nonlinearity, and the offset ``y_0``
        of the output.

    Raises
    ------
    UsageError
        When an order is negative or both are zero, the knots do not increase, or the frequency is not positive.

    References
    ----------
    .. [1] F. Giri, E.-W. Bai, "Block-oriented Nonlinear System Identification", Springer 2010.
    """
    corners = np.asarray(knots, float).ravel().tolist()
    spaces = np.diff(corners)
    if min(before, after) < 0 or before + after < 1 or len(spaces) < 1 or (spaces <= 0).any() or frequency_hz <= 0:
        raise UsageError(
            f"structure {name!r}: before={before}, after={after}, knots={corners}, frequency_hz={frequency_hz}; "
            "give orders of 0 or more, one of them 1 or more, at least two knots that increase, a positive frequency"
        )
    scale, width = 2 * np.pi * frequency_hz, float(spaces.min())
    parameters = [Parameter(f"a_{i}", value) for i, value in enumerate(_butterworth(before))]
    parameters += [Parameter(f"b_{i}", 0.0) for i in range(1, before + 1)]
    parameters += [Parameter(f"c_{i}", value) for i, value in enumerate(_butterworth(after))]
    parameters += [Parameter(f"d_{i}", float(i == 0)) for i in range(after + 1)]
    parameters += [Parameter(f"f_{i}", 0.0) for i in range(len(corners))] + [Parameter("y_0", 0.0)]

    def filtered(x: Any, first: int, u: Any, denominator: list[Any], numerator: list[Any]) -> tuple[list[Any], Any]:
        """Return state derivatives and output of a filter whose states start at index `first`."""
        states = [x[first + i] for i in range(len(denominator))]
        highest = u - sum(a * state for a, state in zip(denominator, states, strict=True))
        terms = zip(numerator, [*states, highest], strict=True)
        return [scale * state for state in [*states[1:], highest][: len(states)]], sum(b * term for b, term in terms)

    def equations(x: Any, u: Any, p: Values) -> tuple[list[Any], Any]:
        a = [p[f"a_{i}"] for i in range(before)]
        b = [*a[:1], *(p[f"b_{i}"] for i in range(1, before + 1))] if before else [1.0]
        inner, w = filtered(x, 0, u[0], a, b)
        bent = w + sum(p[f"f_{i}"] * smooth_hinge(w - knot, width) for i, knot in enumerate(corners))
        c, d = [p[f"c_{i}"] for i in range(after)], [p[f"d_{i}"] for i in range(after + 1)]
        outer, y = filtered(x, before, bent, c, d)
        return inner + outer, y + p["y_0"]

    return NonlinearStructure(
        name,
        parameters,
        [f"x_{i}" for i in range(before + after)],
        lambda x, u, p: equations(x, u, p)[0],
        lambda x, u, p: equations(x, u, p)[1],
        inputs,
        outputs,
        intersample=intersample,
        steps=steps,
    )


def _butterworth(order: int) -> FloatArray:
    """Return the denominator of a Butterworth filter of frequency 1, ascending, without the leading 1: (order,)."""
    poles = np.exp(0.5j * np.pi * (2 * np.arange(order) + order + 1) / max(order, 1))
    return np.real(np.atleast_1d(np.poly(poles)))[:0:-1]
