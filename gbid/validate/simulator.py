"""Simulation of a model on recordings, from the initial state that is closest to the measured outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy

from gbid.arrays import BoolArray, ComplexArray, FloatArray
from gbid.discretise import discretise
from gbid.identify.disturbances.disturbances import UNDISTURBED, Disturbances
from gbid.structure import LinearModel

_WELL_APART = 1e5  # largest condition number of the eigenvectors at which the modes are simulated one by one
_NOTHING = 1e-17  # smaller entries of a basis vector of length one are taken as zero


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of ``x[k+1] = F x[k] + G u[k] + G_next u[k+1]``, one of each conjugate pair.

    Attributes
    ----------
    poles : (n_modes,) complex array
        Poles in discrete time.
    to_modes : (n_modes, n_states) complex array
        Modes of a state.
    drive, lead : (n_modes, n_inputs) complex array
        Effect of ``u[k]`` and ``u[k+1]`` on the modes.
    weights : (n_outputs, n_modes) complex array
        Effect of the modes on the outputs, doubled for a mode that stands for a conjugate pair.
    """

    poles: ComplexArray
    to_modes: ComplexArray
    drive: ComplexArray
    lead: ComplexArray
    weights: ComplexArray


class FreeResponses(NamedTuple):
    """Orthonormal basis of the free responses.

    Attributes
    ----------
    basis : (n_outputs, n_leading, rank) array
        Basis vectors; later samples are zero.
    states : (n_states, rank) array
        Initial state of each basis vector.
    """

    basis: FloatArray
    states: FloatArray


class Explained(NamedTuple):
    """Initial state of a simulation, and its residuals.

    Attributes
    ----------
    initial_state : (n_states,) array
        Least-squares solution of smallest norm.
    residuals : (n_outputs, n_counted) array
        Measured less simulated outputs, at the samples that count.
    """

    initial_state: FloatArray
    residuals: FloatArray


@dataclass(frozen=True, eq=False)
class Simulator:
    """Model prepared for the simulation on many recordings.

    The modes are simulated one by one as filters of first order. The free responses from all initial states have an
    orthonormal basis, which is stored. So the best initial state is found by a projection.

    Attributes
    ----------
    model : LinearModel
        Model in continuous time.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Inter-sample behaviour of the inputs.
    disturbances : Disturbances
        Trends and hum of the outputs, estimated together with the initial state. A random walk counts as an offset.
    name : str
        Recordings to which the model was fitted, for messages.
    """

    model: LinearModel
    sample_time: float
    intersample: str | Sequence[str] = "zoh"
    disturbances: Disturbances = UNDISTURBED
    name: str = "model"
    _modes: Modes | None = field(init=False, repr=False)
    _free: dict[tuple[int, bytes], FreeResponses] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_modes", _modes(self.model, self.sample_time, self.intersample))

    def explain(self, inputs: FloatArray, outputs: FloatArray, counted: BoolArray | None = None) -> Explained:
        """Return the initial state whose simulation is closest to the measured outputs, and the residuals.

        Parameters
        ----------
        inputs : (n_inputs, n_samples) array
            Input signals.
        outputs : (n_outputs, n_samples) array
            Measured outputs.
        counted : (n_samples,) array of bool, optional
            Samples whose outputs count; all by default.

        Returns
        -------
        Explained
            Not finite when the simulation overflows.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            rest = outputs - self.run(inputs)
            rest = rest if counted is None else rest[:, counted]
            if not np.isfinite(rest).all():
                return Explained(np.full(self.model.n_states, np.nan), rest)
            rest = rest - course(
                self.disturbances, self.sample_time, rest, inputs.shape[1], counted
            )  # they drop out of the problem
            free = self._free_responses(inputs.shape, counted)
            head = rest[:, : free.basis.shape[1]]
            found = np.tensordot(free.basis, head, axes=((0, 1), (0, 1)))
            head -= np.tensordot(free.basis, found, axes=(2, 0))
            return Explained(free.states @ found, rest)

    def disturbed(self, error: FloatArray, counted: BoolArray | None = None) -> FloatArray:
        """Return the trend and hum that are closest to an error of the simulation, at all samples.

        Parameters
        ----------
        error : (n_outputs, n_samples) array
            Measured less simulated outputs.
        counted : (n_samples,) array of bool, optional
            Samples that count; all by default.
        """
        there = error if counted is None else error[:, counted]
        return course(self.disturbances, self.sample_time, there, error.shape[1], counted, everywhere=True)

    def run(self, inputs: FloatArray, initial_state: FloatArray | None = None) -> FloatArray:
        """Return the simulated outputs without trend and hum, (n_outputs, n_samples).

        Parameters
        ----------
        inputs : (n_inputs, n_samples) array
            Input signals.
        initial_state : (n_states,) array, optional
            State at the first sample; zero by default.
        """
        modes, model = self._modes, self.model
        if modes is None:
            between = self.intersample
            return model.simulate(inputs.T, self.sample_time, initial_state=initial_state, intersample=between).T
        simulated = model.D @ inputs
        begin = np.zeros(len(modes.poles)) if initial_state is None else modes.to_modes @ initial_state
        columns = zip(modes.poles, modes.drive, modes.lead, modes.weights.T, begin, strict=True)
        for pole, drive, lead, weights, first in columns:
            simple = pole.imag == 0
            now, following = (drive.real, lead.real) if simple else (drive, lead)
            forcing = now @ inputs
            if following.any():
                forcing[:-1] += following @ inputs[:, 1:]
            at = np.array([first.real if simple else first])
            mode, _ = scipy.signal.lfilter([0.0, 1.0], [1.0, -pole.real if simple else -pole], forcing, zi=at)
            simulated += np.outer(weights.real, mode.real)
            if not simple:
                simulated -= np.outer(weights.imag, mode.imag)
        return np.asarray(simulated)

    def _free_responses(self, shape: tuple[int, ...], counted: BoolArray | None) -> FreeResponses:
        n_inputs, n = shape
        key = (n, b"" if counted is None else counted.tobytes())
        if key not in self._free:
            silent = np.zeros((n, n_inputs))
            runs = [
                self.model.simulate(silent, self.sample_time, initial_state=x, intersample=self.intersample).T
                for x in np.eye(self.model.n_states)
            ]
            free = np.stack(runs, axis=2)
            free = free if counted is None else free[:, counted]
            for state in range(self.model.n_states):
                free[:, :, state] -= course(self.disturbances, self.sample_time, free[:, :, state], n, counted)
            self._free[key] = _orthonormal(free)
        return self._free[key]


def course(
    disturbances: Disturbances,
    sample_time: float,
    rest: FloatArray,
    n: int,
    counted: BoolArray | None,
    *,
    everywhere: bool = False,
) -> FloatArray:
    """Return the trend and hum closest to what a simulation leaves; a random walk counts as an offset.

    Parameters
    ----------
    disturbances : Disturbances
        Trends and hum.
    sample_time : float
        Time between samples [s].
    rest : (n_outputs, n_counted) array
        Measured less simulated outputs, at the samples that count.
    n : int
        Number of all samples.
    counted : (n,) array of bool or None
        Samples that count; None for all.
    everywhere : bool
        Whether the course at all samples is wanted, and not at those that count.
    """
    known = disturbances.instead_of_walks(1)
    if not known.n_columns:
        return np.zeros((len(rest), 1))
    columns = known.regressors(n, sample_time)
    there = columns if counted is None else columns[counted]
    return known.closest(rest.T, there) @ (columns if everywhere else there).T


def estimate_initial_state(
    model: LinearModel,
    inputs: FloatArray,
    outputs: FloatArray,
    sample_time: float,
    intersample: str | Sequence[str] = "zoh",
    *,
    disturbances: Disturbances = UNDISTURBED,
    counted: BoolArray | None = None,
) -> FloatArray:
    """Return the initial state whose simulation is closest to the measured outputs, by least squares.

    Parameters
    ----------
    model : LinearModel
        Model in continuous time.
    inputs : (n_samples, n_inputs) array
        Input signals.
    outputs : (n_samples, n_outputs) array
        Measured outputs.
    sample_time : float
        Time between samples [s].
    intersample : {"zoh", "foh"} or sequence of these
        Inter-sample behaviour of the inputs.
    disturbances : Disturbances
        Trends and hum of the outputs, estimated together with the state.
    counted : (n_samples,) array of bool, optional
        Samples whose outputs count; all by default.

    Returns
    -------
    (n_states,) array
        Least-squares solution of smallest norm; nan when the simulation overflows.
    """
    fitted = Simulator(model, sample_time, intersample, disturbances)
    return fitted.explain(np.transpose(inputs), np.transpose(outputs), counted).initial_state


def _modes(model: LinearModel, sample_time: float, intersample: str | Sequence[str]) -> Modes | None:
    """Return the modes of a sampled model; None when its eigenvectors are ill-conditioned or inputs are delayed."""
    if model.delay is not None:
        return None
    F, now, following = discretise(np.array(model.A), np.array(model.B), sample_time, intersample)
    if not np.isfinite(F).all():
        return None
    poles, vectors = np.linalg.eig(F)
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    if not np.linalg.cond(vectors) < _WELL_APART:
        return None
    inverse = np.linalg.inv(vectors)
    keep = poles.imag >= 0
    weights = (model.C @ vectors) * np.where(poles.imag > 0, 2.0, 1.0)
    parts = (poles[keep], inverse[keep], (inverse @ now)[keep], (inverse @ following)[keep], weights[:, keep])
    return Modes(*(part.astype(complex) for part in parts))


def _orthonormal(free: FloatArray) -> FreeResponses:
    n_y, n, n_x = free.shape
    if not np.isfinite(free).all():
        return FreeResponses(np.full((n_y, n, 1), np.inf), np.full((n_x, 1), np.inf))
    columns = free.reshape(n_y * n, n_x)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    left, weight, right = np.linalg.svd(columns / size, full_matrices=False)
    rank = int((weight > np.finfo(float).eps * max(columns.shape) * weight.max(initial=0.0)).sum())
    basis = left[:, :rank].reshape(n_y, n, rank)
    there = np.flatnonzero((np.abs(basis) > _NOTHING).any(axis=(0, 2)))
    leading = np.ascontiguousarray(basis[:, : there[-1] + 1 if there.size else 1])
    return FreeResponses(leading, (right[:rank].T / weight[:rank]) / size[:, None])
