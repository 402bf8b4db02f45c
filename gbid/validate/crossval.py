"""Cross-validation: simulation of models on recordings to which they were not fitted (paper, Sec. 3.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gbid.arrays import FloatArray
from gbid.brief import Brief, Description, brief
from gbid.errors import DataError
from gbid.extras import Pictured, data_frame
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.recording.argument_order import check_order
from gbid.validate.any_simulator import AnySimulator, simulator
from gbid.validate.scores import ValidationScores, join_scores
from gbid.validate.simulator import Explained
from gbid.validate.validation_data import Ranges, ValidationData, validation_data


@dataclass(frozen=True, eq=False)
class Validation(Brief, Pictured):
    """Measured and simulated response of one recording.

    Attributes
    ----------
    recording : str
        Name of the validation recording.
    fitted_to : tuple of str
        Recordings to which the model was fitted.
    fit_percent : (n_outputs,) array
        ``100 (1 - |y - yhat| / |y - mean y|)``.
    infinity_norm : (n_outputs,) array
        Largest deviation, in the units of the outputs.
    measured, simulated : (n_samples, n_outputs) array
        Outputs, also at samples that do not count for the figures above.
    inputs : (n_samples, n_inputs) array
        Inputs of the simulation.
    time : (n_samples,) array
        Time from the first sample [s].
    initial_state : (n_states,) array
        Initial state, estimated on this recording.
    input_names, output_names, input_units, output_units : tuple of str
        Names and units of the channels.
    conditions : dict of str to float
        Operating point of the recording.
    """

    recording: str
    fitted_to: tuple[str, ...]
    fit_percent: FloatArray
    infinity_norm: FloatArray
    measured: FloatArray
    simulated: FloatArray
    inputs: FloatArray
    time: FloatArray
    initial_state: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    conditions: dict[str, float]

    def _brief(self) -> Description:
        figures = {
            name: f"fit {self.fit_percent[j]:.2f} %, largest deviation {self.infinity_norm[j]:.4g} {unit}".rstrip()
            for j, (name, unit) in enumerate(zip(self.output_names, self.output_units, strict=True))
        }
        about = f"model of {', '.join(self.fitted_to)} on {self.recording}, {len(self.time)} samples"
        return brief(self, about, **figures, conditions=self.conditions)

    def to_frame(self) -> Any:
        """Return inputs, measured and simulated outputs over the time as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        columns = {"time_s": self.time, **dict(zip(self.input_names, self.inputs.T, strict=True))}
        units = dict(zip(self.input_names, self.input_units, strict=True))
        for j, name in enumerate(self.output_names):
            columns |= {name: self.measured[:, j], f"{name}_simulated": self.simulated[:, j]}
            units |= {name: self.output_units[j], f"{name}_simulated": self.output_units[j]}
        return data_frame(columns, index="time_s", units=units)


def cross_validate(result: FitResult, recording: Recording, left_out: Ranges = ()) -> Validation:
    """Return the simulation of a fitted model on a recording, with its fit percent and largest deviation.

    The initial state is estimated from the measured outputs, and so are trend and hum when the fit estimated them. A
    random walk counts as an offset. Otherwise the simulation uses the inputs only.

    Parameters
    ----------
    result : FitResult
        Fit with the model, the signals and the inter-sample behaviour of the inputs.
    recording : Recording
        Validation recording.
    left_out : sequence of (start, stop)
        Ranges of samples whose outputs do not count, as in `gbid.fit`. The model is simulated through them.

    Returns
    -------
    Validation

    Raises
    ------
    DataError
        When the recording lacks a signal or has another sample time, when no sample counts, or when the simulation
        overflows.
    """
    check_order(result, "cross_validate(result, recording)")
    data, fitted = validation_data(result, recording, left_out), simulator(result)
    explained = _explain(fitted, data)
    simulated = fitted.run(data.inputs, explained.initial_state)
    simulated = simulated + fitted.disturbed(data.outputs - simulated, data.counted)
    percent, largest = _figures(explained, data)
    return Validation(
        recording=data.name,
        fitted_to=result.recordings,
        fit_percent=percent,
        infinity_norm=largest,
        measured=data.outputs.T,
        simulated=simulated.T,
        inputs=data.inputs.T,
        time=recording.time,
        initial_state=explained.initial_state,
        input_names=data.input_names,
        output_names=data.output_names,
        input_units=data.input_units,
        output_units=data.output_units,
        conditions=data.conditions,
    )


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


def score(fitted: AnySimulator, data: ValidationData) -> tuple[FloatArray, FloatArray]:
    """Return fit percent and largest deviation of one model on one recording.

    Returns
    -------
    fit_percent, infinity_norm : (n_outputs,) array
        Fit in percent, and largest deviation in the units of the outputs.

    Raises
    ------
    DataError
        When model and recording do not fit together, or when the simulation overflows.
    """
    return _figures(_explain(fitted, data), data)


def _figures(explained: Explained, data: ValidationData) -> tuple[FloatArray, FloatArray]:
    rest = explained.residuals
    error = np.sqrt(np.einsum("ik,ik->i", rest, rest))
    return 100 * (1 - error / data.spread), np.abs(rest).max(axis=1)


def _explain(fitted: AnySimulator, data: ValidationData) -> Explained:
    model = fitted.model
    if not np.isclose(data.sample_time, fitted.sample_time, rtol=1e-6, atol=0):
        raise DataError(
            f"recording {data.name!r} has sample time {data.sample_time:g} s; the model was fitted at "
            f"{fitted.sample_time:g} s: resample the recording"
        )
    if (len(data.input_names), len(data.output_names)) != (len(model.input_names), len(model.output_names)):
        raise DataError(
            f"recording {data.name!r} gives the inputs {', '.join(data.input_names)} and the outputs "
            f"{', '.join(data.output_names)}; the model has {', '.join(model.input_names)} and "
            f"{', '.join(model.output_names)}: record the same channels"
        )
    explained = fitted.explain(data.inputs, data.outputs, data.counted)
    if not np.isfinite(explained.residuals).all():
        raise DataError(
            f"the model of {fitted.name} overflows on recording {data.name!r}; "
            "it is unstable: fit it again from another start, or leave it out"
        )
    return explained
