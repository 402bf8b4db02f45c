"""Initial states of the recordings of a fit: estimated, fixed, or functions of the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gbid.arrays import BoolArray, FloatArray, IntArray
from gbid.errors import DataError, UsageError
from gbid.identify.nlp.shooting import Shooting
from gbid.notes.fit_notes import FitNote
from gbid.structure import AnyStructure, ClosedLoop, Parameter, anatomy

OwnState = Literal["estimated", "zero", "structure"] | Sequence[float | Literal["estimated", "structure"]]
InitialState = Literal["auto"] | OwnState | Mapping[str, OwnState]


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
    word : {"estimated", "zero", "structure", "given"}
        The common choice for all recordings; "given" when there are several.
    notes : tuple of str
        What was chosen for the caller.
    """

    values: FloatArray
    released: BoolArray
    word: Literal["estimated", "zero", "structure", "given"]
    notes: tuple[str, ...] = ()

    @property
    def known(self) -> BoolArray:
        """States that are no unknowns of their own, (n_records, n)."""
        return ~np.isnan(self.values) | self.released

    @property
    def shooting(self) -> FloatArray:
        """Fixed states of the shooting problem, (n_records, n); NaN where one is free, zero before an impulse."""
        return np.where(self.released, 0.0, self.values)


def initial_states(
    structure: AnyStructure, parameters: Sequence[Parameter], asked: InitialState, recordings: Sequence[str]
) -> InitialStates:
    """Return the initial states that a caller asked for.

    Parameters
    ----------
    structure : Structure
        Structure of the fit.
    parameters : sequence of Parameter
        Parameters, with the fixed values of the caller.
    asked : {"auto", "estimated", "zero", "structure"}, sequence or dict
        As for `gbid.fit`.
    recordings : sequence of str
        Names of the recordings, by which a dict gives them.

    Raises
    ------
    UsageError
        When a word, a number of states or a recording is wrong, or the structure has no ``x0``.
    DataError
        When a free parameter acts only through initial states that are given otherwise.
    """
    own_parts = anatomy(structure)
    n, stated = own_parts.n_states, bool(own_parts.in_x0)
    notes: tuple[str, ...] = ()
    if isinstance(asked, str) and asked == "auto":
        asked = "structure" if stated else "estimated"
        rest = structure.forgotten_states if isinstance(structure, ClosedLoop) and not stated else ()
        if rest:
            asked = [0.0 if i in rest else "estimated" for i in range(n)]
            notes = (FitNote.AT_REST(f"{len(rest)} states that are soon forgotten are zero at the first sample"),)
    own = asked if isinstance(asked, Mapping) else dict.fromkeys(recordings, asked)
    if set(own) != set(recordings):
        wrong = ", ".join(sorted(set(own) ^ set(recordings)))
        raise UsageError(f"initial_state: give one for each recording of the fit and for no other; wrong: {wrong}")
    rows = [_entries(own[name], n) for name in recordings]
    released = np.array([[entry == "structure" for entry in row] for row in rows], bool).reshape(-1, n)
    values = np.array([[np.nan if isinstance(e, str) else e for e in row] for row in rows], float).reshape(-1, n)
    if released.any() and not stated:
        raise UsageError(
            f"initial_state = 'structure', but structure {structure.name!r} states none; add x0 to its matrices(p), or "
            "x0=... to a nonlinear structure"
        )
    lit = [own_parts.in_x0[i] for i in np.flatnonzero(released.any(axis=0))]
    dark = frozenset().union(*own_parts.in_x0) - own_parts.in_equations.union(*lit)
    lost = [q.name for q in parameters if not q.fixed and q.name in dark]
    if lost:
        raise DataError(
            f"initial_state: no recording begins at the state of which {', '.join(lost)} is a parameter; fix each "
            "(fixed=...), or use initial_state='structure'"
        )
    word = asked if isinstance(asked, str) else "given"
    return InitialStates(values, released, word, notes)  # type: ignore[arg-type]  # `_entries` has refused other words


def released_states(problem: Shooting, theta: FloatArray, record_window: IntArray) -> FloatArray:
    """Return what the structure's ``x0`` adds to the initial state of each record, (n_records, n).

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
    """Return a number or a word for each state."""
    if isinstance(state, str):
        words: dict[str, float | str] = {"estimated": "estimated", "zero": 0.0, "structure": "structure"}
        if state not in words:
            raise UsageError(f"initial_state = {state!r}; choose 'estimated', 'zero', 'structure' or give the state")
        return [words[state]] * n
    if np.shape(state) != (n,):
        raise UsageError(f"initial_state has shape {np.shape(state)}; the structure has {n} states")
    for entry in state:
        if isinstance(entry, str) and entry not in ("estimated", "structure"):
            raise UsageError(f"initial_state: state {entry!r}; give a number, 'estimated' or 'structure'")
        if not isinstance(entry, str) and not np.isfinite(float(entry)):
            raise UsageError(f"initial_state = {state}; it must be finite")
    return [entry if isinstance(entry, str) else float(entry) for entry in state]
