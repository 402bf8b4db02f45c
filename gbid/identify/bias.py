"""Bias of a fit: from delay and hold approximations, from an incomplete structure, and from feedback of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.notes import FitNote
from gbid.discretise.exact import check_holds
from gbid.identify.data import Record
from gbid.identify.pose import Optimum
from gbid.identify.problem.assemble import bounded
from gbid.identify.problem.nlp import Shooting
from gbid.identify.problem.solve import gauss_newton_step
from gbid.identify.problem.states import initial_states
from gbid.identify.uncertainty.residual_tests import followed, whiteness_test
from gbid.structure.built_in import exact_delays
from gbid.structure.kinds import AnyStructure

# A measured input is known at its samples only. First-order hold draws straight lines between them, and a Pade filter
# in place of a delay bends the phase. Both errors act on the estimates, and hardly on the residuals. Their size comes
# from Gauss-Newton steps in a problem with exact delays and inputs on curves.

TELLING = 0.5
"""Standard deviations by which an estimate moves that is named: without it, an interval is wider by an eighth."""
_DECISIVE = 4.5  # difference of log-likelihoods: three standard deviations of one parameter


@dataclass(frozen=True, eq=False)
class OtherHold:
    """Problem of a fit with exact delays and curved inputs between samples, and its estimates.

    Attributes
    ----------
    shooting : Shooting
        The problem.
    theta, starts : (n_theta,) and (n_windows, n) array
        Free parameters and window starts near its optimum.
    moved : (n_theta,) array
        How far the parameters are from those of the fit; not finite where they cannot be computed.
    """

    shooting: Shooting
    theta: FloatArray
    starts: FloatArray
    moved: FloatArray


def other_hold(optimum: Optimum, *, white: bool) -> OtherHold | None:
    """Return the problem of a fit with exact delays and curved inputs between samples, and its estimates.

    Parameters
    ----------
    optimum : Optimum
        Optimum of the fit.
    white : bool
        Whether its residuals are white: then their likelihood can refute the other hold.

    Returns
    -------
    OtherHold or None
        None where delays are exact and inputs are held between samples, as references are, and where the data refute
        inputs on curves. That an input is held is believed: data hardly tell it from one that is half a sample late.
    """
    task, unknowns = optimum.problem.task, optimum.solution.unknowns
    given = optimum.shooting if optimum.reweighted is None else optimum.reweighted.problem
    holds = check_holds(task.hold, len(task.data.input_names))
    exact = exact_delays(task.structure)
    if not (exact or "foh" in holds):
        return None
    theta, starts = given.unpack(unknowns)
    posed = _posed_anew(optimum, *exact) if exact else (given, starts)
    if posed is None:
        return None
    other, starts = posed
    other = _on_curves(other, [i for i, hold in enumerate(holds) if hold == "foh"])
    x, cost, gain = np.clip(other.pack(theta, starts), *other.box), given.at(unknowns).cost, np.nan
    given.release()
    try:
        for _ in range(2 if exact else 1):  # the filters are further away
            iterate, before = other.at(x), x
            x = np.clip(x + gauss_newton_step(other, iterate, x), *other.box)
            gain = (cost - other.cost_alone(*other.unpack(x))) * given.likelihood_size
            # A further step gains less than this one differs from what its slope promises, half of the first order.
            promised = (cost - iterate.cost - iterate.gradient @ (x - before) / 2) * given.likelihood_size
            if white and gain + abs(gain - promised) < -_DECISIVE:
                return None
    except (RuntimeError, ValueError):
        gain = np.nan
    if white and gain < -_DECISIVE:
        return None
    estimate, at = other.unpack(x)
    return OtherHold(other, estimate, at, estimate - theta if np.isfinite(gain) else np.full(len(theta), np.nan))


def _posed_anew(optimum: Optimum, structure: AnyStructure, states: Sequence[int]) -> tuple[Shooting, FloatArray] | None:
    """Return the problem of a fit with another structure, and the window starts of the fit for this structure.

    `states` are the states of the fit that are those of the structure. None with further terms of the caller, which may
    be for the states of the fit.
    """
    problem, task = optimum.problem, optimum.problem.task
    given = optimum.shooting if optimum.reweighted is None else optimum.reweighted.problem
    if given.extra is not None or given.responses:
        return None
    choice = task.options.initial_state if isinstance(task.options.initial_state, str) else "estimated"
    begins = initial_states(structure, task.parameters, choice, [record.name for record in task.data.records])
    other = replace(task, structure=structure, states=begins)
    _, _, assembly = other.assembled(problem.start, problem.parameters, problem.window)
    if [q.name for q in assembly.free] != [q.name for q in problem.assembly.free]:
        return None
    walking = len(problem.assembly.parts[0].predictor.disturbances.walking)
    kept = [*states, *range(given.n_states - walking, given.n_states)]
    parts = [
        replace(part, blocks=part.blocks.with_samples_of(weighted.blocks))
        for part, weighted in zip(assembly.parts, given.parts, strict=True)
    ]
    shooting = replace(given, parts=tuple(parts), links=assembly.links, state_scale=given.state_scale[kept])
    starts = given.unpack(optimum.solution.unknowns)[1][:, kept]
    return bounded(shooting, assembly, begins), starts


_TOGETHER = 32_768  # samples


def _on_curves(problem: Shooting, inputs: Sequence[int]) -> Shooting:
    """Return the problem with some inputs interpolated by curves between samples.

    Notes
    -----
    Over a sample, the mean of a parabola through three samples is ``d^2 u / 12`` below that of the straight line, where
    d^2 u is the second difference. A model that is slow against a sample sees only that mean. So first-order hold of
    ``u - d^2 u / 12`` acts as the curve through u does, up to the fourth order of the sample time; that of u itself is
    off in the second.
    """
    parts = []
    for part in problem.parts:
        segments = []
        for segment in part.blocks.segments:
            u = segment.inputs.copy()
            for first in range(0, len(u) - 2, _TOGETHER):
                rows = segment.inputs[first : first + _TOGETHER + 2, inputs]
                u[first + 1 : first + len(rows) - 1, inputs] -= np.diff(rows, 2, axis=0) / 12
            segments.append(replace(segment, inputs=u))
        parts.append(replace(part, blocks=part.blocks.with_segments(segments)))
    return replace(problem, parts=tuple(parts))


def hold_notes(names: Sequence[str], units: Sequence[str], moved: FloatArray, std: FloatArray) -> list[str]:
    """Return a note on the parameters that delay and hold shift by more than `TELLING` standard deviations.

    Parameters
    ----------
    names, units : sequence of str
        Names of the free parameters, and their units.
    moved : (n_theta,) array
        How far they move.
    std : (n_theta,) array
        Their standard deviations without this bias.
    """
    if not np.isfinite(moved).all():
        return [FitNote.HOLD("with exact delays and inputs on curves between samples the model overflows")]
    each = [
        f"{name} by {shift:+.2g} {unit}".rstrip() + f" ({shift / sigma:+.1f} std)"
        for name, unit, shift, sigma in zip(names, units, moved, std, strict=True)
        if abs(shift) > TELLING * sigma
    ]
    if not each:
        return []
    text = (
        "the inputs are known at their samples only: with exact delays and smooth inputs, estimates would change, "
        f"and their intervals are widened by that: {', '.join(each)}; fit from the references, which are held "
        "(Plant, from r to u and p)"
    )
    return [FitNote.HOLD(text)]


_PAST_INPUTS, _PAST_ERRORS = 12, 4  # lags of the regressions
_AT_ONCE = 1024  # rows
_MOST = 8192  # samples of a record that are enough
_SHARE = 0.02  # smallest share of what is new in an input that the errors must explain
_CERTAIN = 50.0  # the same times the number of samples: far beyond chance for a few regressors


def share_of_feedback(record: Record, errors: FloatArray) -> float:
    """Return the share of an input's innovation explained by past errors: the largest share of all inputs.

    Parameters
    ----------
    record : Record
        Inputs of the fit.
    errors : (n_samples, n_outputs) array
        Errors of the one-step prediction or of the simulation.

    Returns
    -------
    float
        Between 0 and 1; 0 where nothing is significant.

    Notes
    -----
    Errors of the model depend on past inputs. What is new in an input is therefore tested: the part that past inputs do
    not predict. Without feedback past errors cannot predict it either (Granger, Econometrica 37, 1969).
    """
    n = min(record.n_samples, len(errors), _MOST)
    u, e = record.inputs[:n] - record.inputs[:n].mean(axis=0), errors[:n]
    begin = max(_PAST_INPUTS, _PAST_ERRORS)
    columns = (_PAST_INPUTS * u.shape[1], _PAST_ERRORS * e.shape[1])
    if n - begin < 4 * sum(columns) or not u.any():
        return 0.0
    now = u / np.maximum(u[begin:].std(axis=0), np.finfo(float).tiny)
    past = [(u, lag) for lag in range(1, _PAST_INPUTS + 1)] + [(e, lag) for lag in range(1, _PAST_ERRORS + 1)]
    triangle = np.zeros((0, sum(columns) + u.shape[1]))
    for first in range(begin, n, _AT_ONCE):  # QR decomposition of all rows, some at a time
        last = min(first + _AT_ONCE, n)
        rows = np.hstack([*(signal[first - lag : last - lag] for signal, lag in past), now[first:last]])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, rows]), mode="r"))
    # In the columns of an input, the rows below those of some regressors are what these leave of it.
    squares = triangle[:, sum(columns) :] ** 2
    new, left = (squares[above:].sum(axis=0) for above in (columns[0], sum(columns)))
    share = 1 - left / np.where(new > 0, new, 1.0)
    largest = float(np.max(share[new > 1e-9 * (n - begin)], initial=0.0))  # known from its past: left out
    return largest if largest * (n - begin) > _CERTAIN * columns[1] / 8 else 0.0


_CHANCE = 1e-3  # that residuals which follow no input are said to: one campaign of 86 fits in ten has such a fit


def left_out_notes(
    optimum: Optimum, errors: Sequence[FloatArray], others: Sequence[FloatArray] | None, *, white: bool
) -> list[str]:
    """Return a note on errors fed back to the inputs, or on residuals that are correlated with an input.

    Parameters
    ----------
    optimum : Optimum
        Optimum of the fit.
    errors : sequence of (n_samples, n_y) array
        Residuals of each record.
    others : sequence of (n_samples, n_y) array, or None
        Residuals with exact delays and inputs on curves: where they follow no input, delay and hold are the cause, and
        have a note of their own.
    white : bool
        Whether the residuals are white.
    """
    data = optimum.problem.task.data
    inputs = [record.inputs for record in data.records]
    p = followed(errors, inputs, white=white)
    follows = p < _CHANCE / max(1, p.size)
    share = 0.0
    if not white or follows.any():
        share = max(share_of_feedback(record, e) for record, e in zip(data.records, errors, strict=True))
    if share >= _SHARE and white:  # a controller without delay: the input of a sample contains its error
        errors, inputs = [e[1:] for e in errors], [u[:-1] for u in inputs]
        p = followed(errors, inputs, white=white)
        follows = p < _CHANCE / p.size
    elif share >= _SHARE:
        text = (
            f"past errors explain {100 * share:.0f} % of the unpredictable part of an input, as in a control "
            "loop, and the errors are not white: the estimates have a bias; free a disturbance gain "
            "(focus='prediction'), or fit a ClosedLoop"
        )
        return [FitNote.FEEDBACK(text)]
    if not follows.any():
        return []
    if others is not None:
        others = [e[-len(u) :] for e, u in zip(others, inputs, strict=True)]
        if not (followed(others, inputs, white=white) < _CHANCE / p.size).any():
            return []
    notes = [
        f"{output} follow {', '.join(name for name, too in zip(data.input_names, row, strict=True) if too)}"
        for output, row in zip(data.output_names, follows, strict=True)
        if row.any()
    ]
    text = (
        f"the structure is incomplete: the residuals of {', those of '.join(notes)} (p = {p.min():.1g}); the "
        "estimates have a bias, which no standard deviation contains"
    )
    return [FitNote.LEFT_OUT(text)]


class Bias(NamedTuple):
    """Systematic errors of the estimates, beside the noise.

    Attributes
    ----------
    notes : tuple of str
        Notes on it.
    left_out : bool
        Whether residuals follow an input, so that no standard deviation is to be trusted.
    explains_colour : bool
        Whether it may be why residuals are not white, and not the noise.
    moved : (n_theta,) array or None
        How far delay and hold move the estimates; None where they are known to be right.
    widens : bool
        Whether that matters for an interval.
    """

    notes: tuple[str, ...] = ()
    left_out: bool = False
    explains_colour: bool = False
    moved: FloatArray | None = None
    widens: bool = False


def bias_of(optimum: Optimum, errors: Sequence[FloatArray], std: FloatArray, *, white: bool) -> Bias:
    """Return the systematic errors of a converged fit.

    Parameters
    ----------
    optimum : Optimum
        Optimum of the fit.
    errors : sequence of (n_samples, n_y) array
        Residuals of each record; zero for outputs whose errors are at rounding.
    std : (n_theta,) array
        Standard deviations of the free parameters; zero or nan for those on a bound or not determined.
    white : bool
        Whether the residuals are white.
    """
    if not optimum.problem.task.data.input_names:
        return Bias()
    other = other_hold(optimum, white=white)
    others = None
    if other is not None and np.isfinite(other.moved).all():
        others = other.shooting.by_record(
            other.shooting.errors(other.shooting.values(other.theta), other.starts),
            optimum.problem.assembly.record_window,
        )
        other.shooting.release()
        noisy = [any(column.any() for column in columns) for columns in zip(*(e.T for e in errors), strict=True)]
        for e in others:
            e *= noisy
    notes = left_out_notes(optimum, errors, others, white=white)
    left_out = any(FitNote.LEFT_OUT.value in note for note in notes)
    if other is None:
        return Bias((*notes,), left_out, left_out)
    explains_colour = left_out or (not white and others is not None and bool(whiteness_test(others).accepted.all()))
    free = optimum.problem.assembly.free
    moved = np.where(std > 0, other.moved, 0.0)
    told = hold_notes([q.name for q in free], [q.unit for q in free], moved, std)
    widens = bool(told) and bool(np.isfinite(moved).all())
    return Bias((*notes, *told), left_out, explains_colour, moved, widens)
