"""Initial states of a fit (estimated, fixed, given by parameters), constant inputs, start of trend and hum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.errors import DataError, UsageError
from gbid.core.notes import FitNote
from gbid.discretise import Hold
from gbid.identify.data import FitData, moves
from gbid.identify.disturbances import Disturbances
from gbid.identify.options import InitialState, OwnState
from gbid.structure import Parameter
from gbid.structure.kinds import AnyStructure, kind_of

if TYPE_CHECKING:
    from gbid.identify.problem.nlp import Shooting


@dataclass(frozen=True, eq=False)
class InitialStates:
    """Initial states of all recordings.

    Attributes
    ----------
    values : (n_records, n) array
        Fixed values; NaN where a state is estimated or a function of the parameters.
    released : (n_records, n) boolean array
        States that are functions of the parameters: ``x0`` of the structure. Together with the inputs of the model they
        act like an impulse at the first sample, whose response starts from there.
    choice : str, sequence or dict
        As for `gbid.fit`, with what "auto" is.
    notes : tuple of str
        What was chosen for the caller.
    """

    values: FloatArray
    released: BoolArray
    choice: InitialState
    notes: tuple[str, ...] = ()

    @property
    def known(self) -> BoolArray:
        """States that are not separate unknowns, (n_records, n)."""
        return ~np.isnan(self.values) | self.released

    def in_shooting(self, n_states: int) -> BoolArray:
        """Return `known` extended by the random-walk offsets, which are estimated, (n_records, n_states)."""
        return np.pad(self.known, ((0, 0), (0, n_states - self.known.shape[1])))

    @property
    def shooting(self) -> FloatArray:
        """Fixed states of the shooting problem, (n_records, n); NaN for free states, zero before an impulse."""
        return np.where(self.released, 0.0, self.values)


def initial_states(
    structure: AnyStructure, parameters: Sequence[Parameter], choice: InitialState, recordings: Sequence[str]
) -> InitialStates:
    """Return the initial states that the caller chose.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    parameters : sequence of Parameter
        Parameters, with the fixed values of the caller.
    choice : {"auto", "estimated", "zero", "structure"}, sequence or dict
        As for `gbid.fit`.
    recordings : sequence of str
        Names of the recordings, by which a dict gives them.

    Raises
    ------
    UsageError
        When a number of states or a recording is wrong, or the structure has no ``x0``.
    DataError
        When a free parameter acts only through initial states that are given otherwise.
    """
    kind = kind_of(structure)
    anatomy = kind.anatomy()
    n, stated = anatomy.n_states, bool(anatomy.in_x0)
    notes: tuple[str, ...] = ()
    if isinstance(choice, str) and choice == "auto":
        choice = "structure" if stated else "estimated"
        rest = kind.states_at_rest
        if rest and not stated:
            choice = [0.0 if i in rest else "estimated" for i in range(n)]
            notes = (FitNote.AT_REST(f"{len(rest)} quickly decaying states are zero at the first sample"),)
    chosen = choice if isinstance(choice, Mapping) else dict.fromkeys(recordings, choice)
    if wrong := sorted(set(chosen) ^ set(recordings)):
        names = ", ".join(wrong)
        raise UsageError(f"initial_state: give one for each recording of the fit and for no other; wrong: {names}")
    rows = [_entries(chosen[name], n) for name in recordings]
    released = np.array([[entry == "structure" for entry in row] for row in rows], bool).reshape(-1, n)
    values = np.array([[np.nan if isinstance(e, str) else e for e in row] for row in rows], float).reshape(-1, n)
    if released.any() and not stated:
        raise UsageError(
            f"initial_state = 'structure', but structure {structure.name!r} states none; add x0 to its matrices(p), or "
            "x0=... to a nonlinear structure"
        )
    begun = [anatomy.in_x0[i] for i in np.flatnonzero(released.any(axis=0))]
    hidden = frozenset().union(*anatomy.in_x0) - anatomy.in_equations.union(*begun)
    if lost := [q.name for q in parameters if not q.fixed and q.name in hidden]:
        raise DataError(
            f"initial_state: no recording starts from the state with {', '.join(lost)}; fix each of these "
            "(fixed=...), or use initial_state='structure'"
        )
    return InitialStates(values, released, choice, notes)


def released_states(problem: Shooting, theta: FloatArray, record_window: IntArray) -> FloatArray:
    """Return the contribution of the structure's ``x0`` to each record's initial state, (n_records, n).

    Parameters
    ----------
    problem : Shooting
        Problem of the fit.
    theta : (n_p,) array
        Free parameters.
    record_window : (n_records,) integer array
        First window of each record.
    """
    parts = [problem.parts[k] for k in np.searchsorted(problem.first_window, record_window, side="right") - 1]
    return np.array([part.predictor.released_state(part.own(theta)) for part in parts])


def _entries(state: OwnState, n: int) -> Sequence[float | str]:
    """Return a number or a keyword for each state."""
    if isinstance(state, str):
        return [0.0 if state == "zero" else state] * n
    if np.shape(state) != (n,):
        raise UsageError(f"initial_state has shape {np.shape(state)}; the structure has {n} states")
    entries = [entry if isinstance(entry, str) else float(entry) for entry in state]
    if not np.isfinite([entry for entry in entries if not isinstance(entry, str)]).all():
        raise UsageError(f"initial_state = {state}; it must be finite")
    return entries


# ---- Constant inputs: free decays and constant forces.


def check_inputs_suffice(
    structure: AnyStructure, data: FitData, parameters: Sequence[Parameter], *, no_inputs: bool
) -> None:
    """Refuse free parameters that act only through constant inputs.

    An input that is zero in all recordings determines neither its gain nor its delay. A constant input determines its
    gain, but not its delay.

    Parameters
    ----------
    structure : Structure
        Structure of the fit, with its inputs.
    data : FitData
        Data of the fit.
    parameters : sequence of Parameter
        Parameters, with the fixed values of the caller.
    no_inputs : bool
        Whether the fit uses no input at all.

    Raises
    ------
    DataError
        When a free parameter is not determined; names it and the inputs.
    """
    constant = ~np.any([moves(record.inputs) for record in data.records], axis=0)
    if not (constant.any() or no_inputs):
        return
    kind = kind_of(structure)
    anatomy = kind.anatomy()
    if no_inputs:
        zero = constant = np.ones(anatomy.n_inputs, bool)
    elif anatomy.n_inputs == len(data.input_names):
        zero = constant & np.all([record.inputs[0] == 0 for record in data.records], axis=0)
    else:
        return  # another check reports the number of inputs
    driven, moving = np.flatnonzero(~zero).tolist(), np.flatnonzero(~constant).tolist()
    begins = frozenset().union(*anatomy.in_x0)
    hidden = (anatomy.in_equations | begins) - (kind.anatomy(driven, moving).in_equations | begins)
    if lost := [q.name for q in parameters if not q.fixed and q.name in hidden]:
        quiet = ", ".join(name for name, rests in zip(data.input_names, constant, strict=False) if rests)
        what = "without an input" if no_inputs else f"no recording moves {quiet}:"
        raise DataError(
            f"{what} the data do not determine {', '.join(lost)}; fix each (fixed=...), or add a recording with an "
            "input that moves"
        )


def decay_notes(data: FitData) -> tuple[str, ...]:
    """Return notes on inputs that are constant over a recording: a free decay or a constant force."""
    return tuple(
        FitNote.STEADY_INPUT(
            f"recording {record.name!r}: input {name!r} is {column[0]:g} throughout, "
            + ("a free decay" if column[0] == 0 else "a constant force")
        )
        for record in data.records
        for name, column in zip(data.input_names, record.inputs.T, strict=True)
        if not moves(column)
    )


# ---- Trend and hum: their start values, and data without them.

_RUNAWAY = 1e3  # size of a simulation, in that of the outputs, beyond which the model counts as unstable


def disturbance_starts(
    disturbances: Disturbances,
    structure: AnyStructure,
    begin: Mapping[str, float],
    data: FitData,
    intersample: Hold | Sequence[Hold],
) -> list[dict[str, float]]:
    """Return start values of disturbances for each record, from least squares on simulation residuals.

    Parameters
    ----------
    disturbances : Disturbances
        The disturbances.
    structure : Structure
        Structure of the fit.
    begin : dict of str to float
        Start values of its parameters.
    data : FitData
        Data of the fit.
    intersample : {"zoh", "foh"} or sequence of these
        Behaviour of the inputs between samples.

    Returns
    -------
    list of dict of str to float
        Coefficients and gains by name. The offset is that of the median, because the first samples contain the
        response to the initial state. An unstable model counts as zero.
    """
    gains = {q.name: float(q.start or 0.0) for q in disturbances.walk_gains(data.sample_time)}
    if not disturbances.terms:
        return [gains for _ in data.records]
    model, starts = kind_of(structure).model(begin), []
    for record in data.records:
        clock = data.sample_time if record.time is None else record.time
        left = record.outputs - model.simulate(record.inputs, clock, intersample=intersample)
        if not np.abs(left).max() < _RUNAWAY * np.abs(record.outputs).max():
            left = record.outputs
        columns = disturbances.regressors(data.time_of(record))
        coefficients = disturbances.closest(left, columns)
        rest = np.median(left - columns @ coefficients.T, axis=0)
        coefficients[:, 0] += rest * [trend.n_terms > 0 for trend in disturbances.trends]
        values = coefficients[disturbances.places].tolist()
        starts.append(gains | {term.name: v for term, v in zip(disturbances.terms, values, strict=True)})
    return starts


def without_disturbances(disturbances: Disturbances, data: FitData) -> FitData:
    """Return the data without drift and hum, for start values found in the data.

    The fit itself uses the data as they are. Offsets alone are left, because start values do not depend on them.
    """
    known = disturbances.instead_of_walks(2)
    if known.n_columns < 2:
        return data
    records = []
    for record in data.records:
        columns = known.regressors(data.time_of(record))
        course = columns @ known.closest(record.outputs, columns).T
        records.append(replace(record, outputs=record.outputs - course))
    return replace(data, records=tuple(records))
