"""Match of a structure to the frequency response of a black-box model: parameters without start values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy

from gbid.arrays import ComplexArray, FloatArray
from gbid.identify.predictor import Predictor

_SAME, _AGREEING = 1e-3, 3  # largest relative difference of equal misfits, and the number of them that is enough
_POOR = 0.3  # smallest misfit that is not believed, however often it is found
_CAPPED = 1e12  # largest size of a residual, so that squares of wild starts stay finite


@dataclass(frozen=True, eq=False)
class Target:
    """Response in continuous time that a structure is matched to.

    Attributes
    ----------
    s : (n,) complex array
        Points ``i 2 pi f`` [rad/s].
    response : (n, n_y, n_columns) complex array
        Response from the inputs, or of free decays.
    weight : (n, n_y, n_columns) array
        One over the standard deviation.
    poles : (n_poles,) complex array
        Poles of the black-box model in continuous time [rad/s].
    decays : bool
        Whether the columns are free decays, whose initial states are unknown.
    """

    s: ComplexArray
    response: ComplexArray
    weight: FloatArray
    poles: ComplexArray
    decays: bool


@dataclass(frozen=True, eq=False)
class Match:
    """Parameters that were found by a match.

    Attributes
    ----------
    theta : (n_free,) array
        The parameters.
    misfit : float
        Part of the weighted response that remains, from 0 (exact) to about 1.
    """

    theta: FloatArray
    misfit: float


def match(
    predictor: Predictor, target: Target, starts: Iterable[FloatArray], lower: FloatArray, upper: FloatArray
) -> Match:
    """Return parameters at which a structure has the response of a target.

    Parameters
    ----------
    predictor : Predictor
        Predictor of the structure; its matrices are used.
    target : Target
        The response.
    starts : iterable of (n_free,) array
        Start values of the match. No more are taken when several have led to the smallest misfit.
    lower, upper : (n_free,) array
        Bounds.

    Returns
    -------
    Match
        The best one.

    Notes
    -----
    The first stage minimises ``d(s) / q(s) (G_0(s) - G(s))``: the difference of the responses times the characteristic
    polynomial d of the structure, over that of the black-box model q. In the coefficients of the transfer function this
    is a linear least-squares problem (Levy; Sanathanan and Koerner, 1963), so that it leads to the resonances from far
    off, where the response has a local minimum at each of them. The second stage minimises the difference itself.
    For free decays ``B`` is replaced by the initial states, which enter linearly and are eliminated.
    """
    found: list[Match] = []
    for start in starts:
        rough = _solve(predictor, target, start, lower, upper, True, 60)
        found.append(_solve(predictor, target, rough.theta, lower, upper, False, 100))
        least = min(each.misfit for each in found)
        if least < _POOR and sum(each.misfit <= least * (1 + _SAME) + 1e-9 for each in found) >= _AGREEING:
            break
    return min(found, key=lambda each: each.misfit)


def _solve(
    predictor: Predictor,
    target: Target,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    equation: bool,
    steps: int,
) -> Match:
    reference = np.linalg.norm(target.response * target.weight)

    def both(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        value, slope = _residual(predictor, target, theta, equation)
        flat = np.concatenate([value.real.ravel(), value.imag.ravel()]) / reference
        jac = np.concatenate([slope.real.reshape(len(slope), -1), slope.imag.reshape(len(slope), -1)], 1).T / reference
        if not (np.isfinite(flat).all() and np.isfinite(jac).all()):
            return np.full(len(flat), _CAPPED), np.zeros(jac.shape)
        return flat, jac

    last: dict[str, object] = {}

    def function(theta: FloatArray) -> FloatArray:
        last["theta"], (last["value"], last["slope"]) = theta.copy(), both(theta)
        return last["value"]  # type: ignore[return-value]

    def slope(theta: FloatArray) -> FloatArray:
        if not np.array_equal(theta, last["theta"]):  # type: ignore[arg-type]
            function(theta)
        return last["slope"]  # type: ignore[return-value]

    inside = np.clip(start, lower, upper)
    width = np.where(np.isfinite(upper - lower), upper - lower, np.maximum(np.abs(inside), 1.0))
    inside = np.clip(inside, lower + 1e-9 * width, upper - 1e-9 * width)
    with np.errstate(all="ignore"):
        try:
            found = scipy.optimize.least_squares(
                function,
                inside,
                jac=slope,
                bounds=(lower, upper),
                x_scale="jac",
                max_nfev=steps,
                xtol=1e-10,
                ftol=1e-10,
            ).x
        except (np.linalg.LinAlgError, ValueError):
            found = inside
        misfit = float(np.linalg.norm(both(found)[0]))
    return Match(found, misfit if np.isfinite(misfit) else _CAPPED)


def _residual(
    predictor: Predictor, target: Target, theta: FloatArray, equation: bool
) -> tuple[ComplexArray, ComplexArray]:
    """Return the weighted differences (n, n_y, n_columns), and their derivatives (n_free, n, n_y, n_columns)."""
    A, B, C, D, _, B_delayed, delay = predictor.matrices(theta)
    s = target.s
    n = len(A.value)
    inverse = np.asarray(np.linalg.inv(s[:, None, None] * np.eye(n) - A.value), complex)
    left: ComplexArray = np.asarray(C.value @ inverse, complex)
    if target.decays:
        size = np.abs(_characteristic_ratio(A.value, target)) if equation else np.ones(len(s))
        value, d_value = _decay(target, target.weight * size[:, None, None], inverse, left, A.slope, C.slope)
    else:
        drive = np.broadcast_to(B.value, (len(s), *B.shape)).astype(complex)
        d_drive = np.repeat(B.slope[:, None], len(s), 1).astype(complex)
        for k, i in enumerate(predictor.delayed):
            late = np.exp(-s * delay.value[k, 0])
            drive[:, :, i] += B_delayed.value[:, i] * late[:, None]
            d_drive[..., i] += B_delayed.slope[:, None, :, i] * late[:, None]
            d_drive[..., i] -= (s * late)[:, None] * B_delayed.value[:, i] * delay.slope[:, k, 0, None, None]
        states = inverse @ drive
        value = left @ drive + D.value
        d_value = (
            np.einsum("pyn,fnu->pfyu", C.slope, states, optimize=True)
            + np.einsum("fyn,pfnu->pfyu", left, np.einsum("pnm,fmu->pfnu", A.slope, states) + d_drive, optimize=True)
            + D.slope[:, None]
        )
    difference = (target.response - value) * target.weight
    d_difference = -d_value * target.weight
    if not equation:
        return difference, d_difference
    ratio = _characteristic_ratio(A.value, target)
    d_log = -np.einsum("fnm,pmn->pf", inverse, A.slope, optimize=True)
    change = d_difference + d_log[:, :, None, None] * difference
    return ratio[:, None, None] * difference, ratio[:, None, None] * change


def _characteristic_ratio(A: FloatArray, target: Target) -> ComplexArray:
    """Return ``det(s I - A)`` over the polynomial of the poles of the black-box model."""
    poles = np.linalg.eigvals(A)
    s, known = target.s, target.poles
    middle = float(np.sqrt(np.abs(s[0]) * np.abs(s[-1])))
    padded = np.concatenate([known, np.full(max(len(poles) - len(known), 0), -middle)])[: max(len(poles), len(known))]
    logs = np.log(s[:, None] - poles).sum(1) - np.log(s[:, None] - padded).sum(1)
    return np.asarray(np.exp(np.clip(logs.real, -200, 200) + 1j * logs.imag))


def _decay(
    target: Target, weights: FloatArray, inverse: ComplexArray, left: ComplexArray, dA: FloatArray, dC: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the response ``C (s I - A)^-1 X`` with the best initial states X (n, n_columns), and its derivatives."""
    n_f, n_y, n = left.shape
    value = np.zeros(target.response.shape, complex)
    d_value = np.zeros((len(dA), *target.response.shape), complex)
    for j in range(target.response.shape[2]):
        weight = weights[:, :, j]
        rows = (left * weight[:, :, None]).reshape(n_f * n_y, n)
        base = np.vstack([rows.real, rows.imag])
        goal = (target.response[:, :, j] * weight).ravel()
        x = np.linalg.lstsq(base, np.concatenate([goal.real, goal.imag]), rcond=1e-12)[0]
        states = inverse @ x
        value[:, :, j] = np.einsum("fyn,n->fy", left, x)
        d_value[..., j] = np.einsum("pyn,fn->pfy", dC, states) + np.einsum(
            "fyn,pnm,fm->pfy", left, dA, states, optimize=True
        )
        # what the initial state follows of the change (Kaufman's form of variable projection)
        flat = (d_value[..., j] * weight).reshape(len(dA), -1)
        moved = np.concatenate([flat.real, flat.imag], 1)
        Q = np.linalg.qr(base)[0]
        rest = moved - (moved @ Q) @ Q.T
        half = rest.shape[1] // 2
        d_value[..., j] = (rest[:, :half] + 1j * rest[:, half:]).reshape(len(dA), n_f, n_y) / weight
    return value, d_value
