"""Cross-validation of many models on many recordings, about a hundred times faster than `cross_validate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbid.arrays import BoolArray, ComplexArray, FloatArray
from gbid.discretise import discretise
from gbid.errors import DataError
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.validate.crossval import Ranges, counted_samples, selected
from gbid.validate.scores import ValidationScores, join_scores

_WELL_APART = 1e5  # largest condition number of the eigenvectors at which the modes are simulated one by one
_NOTHING = 1e-17  # smaller entries of a basis vector of length one are taken as zero


@dataclass(frozen=True, eq=False)
class ValidationData:
    """Inputs and outputs of one recording, arranged for the simulation of many models.

    Attributes
    ----------
    name : str
        Name of the recording.
    conditions : dict of str to float
        Operating point of the recording.
    sample_time : float
        Time between samples [s].
    inputs : (n_inputs, n_samples) array
        Input signals.
    outputs : (n_outputs, n_samples) array
        Measured outputs.
    counted : (n_samples,) array of bool or None
        Samples that count; None when all count.
    input_names, output_names, output_units : tuple of str
        Names and units of the channels.
    spread : (n_outputs,) array
        Norm of each output about its mean.
    """

    name: str
    conditions: dict[str, float]
    sample_time: float
    inputs: FloatArray
    outputs: FloatArray
    counted: BoolArray | None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    spread: FloatArray


@dataclass(frozen=True, eq=False)
class Simulator:
    """Fitted model prepared for the simulation on many recordings.

    The modes of ``x[k+1] = F x[k] + G u[k] + G_next u[k+1]`` are simulated one by one as filters of first order. The
    free responses from all initial states have an orthonormal basis, which is stored. So the best initial state is
    found by a projection.

    Attributes
    ----------
    result : FitResult
        The fit.
    poles : (n_modes,) complex array or None
        Poles, one of each conjugate pair; None when the eigenvectors are too ill-conditioned for modes.
    drive, lead : (n_modes, n_inputs) complex array
        Effect of ``u[k]`` and ``u[k+1]`` on the modes.
    weights : (n_outputs, n_modes) complex array
        Effect of the modes on the outputs, doubled for a mode that stands for a conjugate pair.
    bases : dict
        Bases of the free responses, by number of samples and samples that count.
    """

    result: FitResult
    poles: ComplexArray | None
    drive: ComplexArray
    lead: ComplexArray
    weights: ComplexArray
    bases: dict[tuple[int, bytes], FloatArray]

    @property
    def model(self) -> LinearModel:
        """The model of the fit."""
        return self.result.model


def validation_data(result: FitResult, recording: Recording, left_out: Ranges = ()) -> ValidationData:
    """Return the signals of a recording on which the models of a fit are validated.

    Parameters
    ----------
    result : FitResult
        Any fit of these models; it names the signals.
    recording : Recording
        Validation recording.
    left_out : sequence of (start, stop)
        Ranges of samples that do not count.

    Raises
    ------
    DataError
        When the recording lacks a signal, has another sample time, or has no sample that counts.
    """
    (u, input_names, _), (y, output_names, output_units) = selected(result, recording)
    counted = counted_samples(recording, left_out)
    kept = y if counted is None else y[counted]
    return ValidationData(
        recording.name,
        dict(recording.conditions),
        recording.sample_time,
        np.ascontiguousarray(u.T),
        np.ascontiguousarray(y.T),
        counted,
        tuple(input_names),
        tuple(output_names),
        tuple(output_units),
        np.linalg.norm(kept - kept.mean(axis=0), axis=0),
    )


def simulator(result: FitResult) -> Simulator:
    """Return a fitted model prepared for the simulation on many recordings."""
    model = result.model
    nothing = np.zeros((0, 0), complex)
    if model.delay is not None:
        return Simulator(result, None, nothing, nothing, nothing, {})
    F, now, following = discretise(np.array(model.A), np.array(model.B), result.sample_time, result.options.intersample)
    poles, vectors = np.linalg.eig(F)
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    if not np.linalg.cond(vectors) < _WELL_APART:
        return Simulator(result, None, nothing, nothing, nothing, {})
    inverse = np.linalg.inv(vectors)
    keep = poles.imag >= 0
    twice = np.where(poles.imag > 0, 2.0, 1.0)
    weights = (model.C @ vectors) * twice
    return Simulator(
        result,
        poles[keep].astype(complex),
        (inverse @ now)[keep].astype(complex),
        (inverse @ following)[keep].astype(complex),
        weights[:, keep].astype(complex),
        {},
    )


def score(fitted: Simulator, data: ValidationData) -> tuple[FloatArray, FloatArray]:
    """Return fit percent and largest deviation of one model on one recording, as `cross_validate` computes them.

    Returns
    -------
    fit_percent, infinity_norm : (n_outputs,) array
        Fit in percent, and largest deviation in the units of the outputs.

    Raises
    ------
    DataError
        When model and recording do not fit together, or when the simulation overflows.
    """
    _check_pair(fitted, data)
    with np.errstate(over="ignore", invalid="ignore"):
        rest = data.outputs - _from_rest(fitted, data)
        if data.counted is not None:
            rest = rest[:, data.counted]
        if fitted.result.options.offsets:
            rest = rest - rest.mean(axis=1, keepdims=True)
        if np.isfinite(rest).all():
            basis = _basis(fitted, data)
            head = rest[:, : basis.shape[1]]
            head -= np.tensordot(basis, np.tensordot(basis, head, axes=((0, 1), (0, 1))), axes=(2, 0))
    if not np.isfinite(rest).all():
        raise DataError(
            f"the model of {', '.join(fitted.result.recordings)} overflows on recording {data.name!r}; "
            "it is unstable: fit it again from another start, or leave it out"
        )
    error = np.sqrt(np.einsum("ik,ik->i", rest, rest))
    return 100 * (1 - error / data.spread), np.abs(rest).max(axis=1)


def cross_validate_many(
    results: Sequence[FitResult],
    recordings: Sequence[Recording],
    pairs: Sequence[tuple[int, int]] | None = None,
) -> ValidationScores:
    """Return the scores of many models on many recordings, as `cross_validate` computes them for each pair.

    Parameters
    ----------
    results : sequence of FitResult
        Fits of one structure to the same signals.
    recordings : sequence of Recording
        Validation recordings.
    pairs : sequence of (int, int), optional
        Pairs of model and recording, by their positions. By default each model is simulated on all recordings to which
        it was not fitted.

    Returns
    -------
    ValidationScores

    Raises
    ------
    DataError
        As for `cross_validate`, or when there is no pair.
    """
    if pairs is None:
        pairs = [
            (i, j) for i, r in enumerate(results) for j, rec in enumerate(recordings) if rec.name not in r.recordings
        ]
    if not pairs:
        raise DataError("no pair of model and recording to validate; give recordings that no model was fitted to")
    fitted = {i: simulator(results[i]) for i in dict.fromkeys(i for i, _ in pairs)}
    data = {j: validation_data(results[pairs[0][0]], recordings[j]) for j in dict.fromkeys(j for _, j in pairs)}
    found = [(i, j, *score(fitted[i], data[j])) for i, j in pairs]
    return join_scores([(" ".join(results[i].recordings), data[j], fit, norm) for i, j, fit, norm in found])


def _check_pair(fitted: Simulator, data: ValidationData) -> None:
    result, model = fitted.result, fitted.model
    if not np.isclose(data.sample_time, result.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recording {data.name!r} has sample time {data.sample_time:g} s; the model was fitted at "
            f"{result.sample_time:g} s: resample the recording"
        )
    if (len(data.input_names), len(data.output_names)) != (len(model.input_names), len(model.output_names)):
        raise DataError(
            f"recording {data.name!r} gives the inputs {', '.join(data.input_names)} and the outputs "
            f"{', '.join(data.output_names)}; the model has {', '.join(model.input_names)} and "
            f"{', '.join(model.output_names)}: record the same channels"
        )


def _from_rest(fitted: Simulator, data: ValidationData) -> FloatArray:
    """Return the simulation from the zero state, (n_outputs, n_samples)."""
    from scipy.signal import lfilter  # imported here, because the import is slow

    model, u = fitted.model, data.inputs
    if fitted.poles is None:
        return np.asarray(model.simulate(u.T, data.sample_time, intersample=fitted.result.options.intersample).T)
    simulated = model.D @ u
    for pole, drive, lead, weights in zip(fitted.poles, fitted.drive, fitted.lead, fitted.weights.T, strict=True):
        simple = pole.imag == 0
        now, following = (drive.real, lead.real) if simple else (drive, lead)
        forcing = now @ u
        if following.any():
            forcing[:-1] += following @ u[:, 1:]
        mode = lfilter([0.0, 1.0], [1.0, -pole.real if simple else -pole], forcing)
        simulated += np.outer(weights.real, mode.real)
        if not simple:
            simulated -= np.outer(weights.imag, mode.imag)
    return np.asarray(simulated)


def _basis(fitted: Simulator, data: ValidationData) -> FloatArray:
    """Return an orthonormal basis of the free responses, (n_outputs, n_leading, rank); later samples are zero."""
    n = data.inputs.shape[1]
    key = (n, b"" if data.counted is None else data.counted.tobytes())
    if key not in fitted.bases:
        model = fitted.model
        silent = np.zeros((n, len(data.input_names)))
        between = fitted.result.options.intersample
        starts = np.eye(model.n_states)
        runs = [model.simulate(silent, data.sample_time, initial_state=x, intersample=between).T for x in starts]
        free = np.stack(runs, axis=2)
        if data.counted is not None:
            free = free[:, data.counted]
        if fitted.result.options.offsets:
            free = free - free.mean(axis=1, keepdims=True)
        fitted.bases[key] = _orthonormal(free) if np.isfinite(free).all() else np.full((len(free), n, 1), np.inf)
    return fitted.bases[key]


def _orthonormal(free: FloatArray) -> FloatArray:
    n_y, n, n_x = free.shape
    columns = free.reshape(n_y * n, n_x)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    left, weight, _ = np.linalg.svd(columns / size, full_matrices=False)
    rank = int((weight > np.finfo(float).eps * max(columns.shape) * weight.max(initial=0.0)).sum())
    basis = left[:, :rank].reshape(n_y, n, rank)
    there = np.flatnonzero((np.abs(basis) > _NOTHING).any(axis=(0, 2)))
    return np.ascontiguousarray(basis[:, : there[-1] + 1 if there.size else 1])
