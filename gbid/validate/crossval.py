"""Cross-validation (paper, Sec. 3.8): simulation on recordings not used in the fit, scores, and their summary."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from math import log
from typing import Annotated, Any, ClassVar

import numpy as np

from gbid.core import hdf5
from gbid.core.arrays import FloatArray, IntArray, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError
from gbid.core.extras import data_frame
from gbid.core.figures import Figure, Pictured
from gbid.core.hdf5 import Stored
from gbid.core.option_types import Count, CountOrZero
from gbid.core.tables import Cell, Column, Entry, Row, Table, formatted
from gbid.identify import FitResult
from gbid.identify.data import select
from gbid.recording import Recording
from gbid.validate.simulate import Explained, Ranges, Simulator, ValidationData, at_clock_of, simulator, validation_data

_SHOWN_POINTS = 30  # largest number of operating points that have their own rows
_FEWEST_DRAWN = 6  # smallest number of pairs for a histogram


@dataclass(frozen=True, eq=False)
class ValidationScores(Brief):
    """Scores of n pairs (model, recording) with q outputs.

    Attributes
    ----------
    models : tuple of str, n
        Recordings to which each model was fitted, or name of the model.
    recordings : tuple of str, n
        Validation recordings.
    pressure_bar, speed_rpm : (n,) array
        Operating points of the recordings; nan when unknown.
    output_names, output_units : tuple of str, q
        Names and units of the outputs.
    fit_percent : (n, q) array
        Fit of the simulation in percent.
    infinity_norm : (n, q) array
        Largest deviation of the simulation, in the units of the outputs.
    """

    models: tuple[str, ...]
    recordings: tuple[str, ...]
    pressure_bar: FloatArray
    speed_rpm: FloatArray
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    fit_percent: FloatArray
    infinity_norm: FloatArray

    def _brief(self) -> Description:
        return brief(
            self,
            f"{len(self.models)} pairs of model and recording",
            models=self.models,
            output_names=self.output_names,
            fit_percent=self.fit_percent,
            infinity_norm=self.infinity_norm,
        )

    def __len__(self) -> int:
        return len(self.models)

    def to_frame(self) -> Any:
        """Return the scores as a data frame with a row for each pair (model, recording).

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        columns = {
            "model": self.models,
            "recording": self.recordings,
            "pressure_bar": self.pressure_bar,
            "speed_rpm": self.speed_rpm,
        }
        units = {"pressure_bar": "bar", "speed_rpm": "rpm"}
        for j, (name, unit) in enumerate(zip(self.output_names, self.output_units, strict=True)):
            columns |= {
                f"fit_percent_{name}": self.fit_percent[:, j],
                f"infinity_norm_{name}": self.infinity_norm[:, j],
            }
            units |= {f"fit_percent_{name}": "%", f"infinity_norm_{name}": unit}
        return data_frame(columns, units=units)


@dataclass(frozen=True)
class WorstPair:
    """Pair (model, recording) with a poor fit of one output.

    Attributes
    ----------
    model, recording, output : str
        Names of the model, the recording and the output.
    fit_percent : float
        Fit of the output in percent.
    infinity_norm : float
        Largest deviation, in the unit of the output.
    """

    model: str
    recording: str
    output: str
    fit_percent: Annotated[float, Stored("%", "fit percent")]
    infinity_norm: Annotated[float, Stored("as the output's", "infinity norm")]


@dataclass(frozen=True, eq=False)
class PointSummary(Brief):
    """Summary of the validation pairs at one operating point.

    Attributes
    ----------
    pressure_bar, speed_rpm : float
        Operating point; nan when unknown.
    n_pairs : int
        Number of pairs.
    mean, std : (n_outputs,) array
        Mean and standard deviation of the fit percent; std is nan for a single pair.
    infinity_norm : (n_outputs,) array
        Largest deviation over the pairs, in the units of the outputs.
    """

    pressure_bar: Annotated[float, Stored("bar", "supply pressure")]
    speed_rpm: Annotated[float, Stored("rpm", "shaft speed")]
    n_pairs: Annotated[int, Stored("1", "pairs of the operating point")]
    mean: Annotated[FloatArray, Stored("%", "mean of the fit percent, points by outputs", "q")]
    std: Annotated[FloatArray, Stored("%", "standard deviation of the fit percent, points by outputs", "q")]
    infinity_norm: Annotated[
        FloatArray, Stored("as attribute output_units", "largest deviation, points by outputs", "q")
    ]


@dataclass(frozen=True, eq=False)
class ValidationSummary(Brief, Pictured, hdf5.InFile):
    """Summary of a cross-validation with q outputs and b histogram bins.

    Attributes
    ----------
    n_pairs, n_models, n_recordings : int
        Numbers of pairs, models and recordings.
    output_names, output_units : tuple of str, q
        Names and units of the outputs.
    mean, std : (q,) array
        Mean and standard deviation (with n - 1) of the fit percent over the pairs; std is nan for a single pair.
    median, least, greatest : (q,) array
        Median, smallest and largest fit percent.
    edges : (q, b + 1) array
        Edges of the histogram bins [%].
    counts : (q, b) integer array
        Number of pairs in each bin, without those in `below`.
    below : (q,) integer array
        Number of pairs whose fit lies below the first edge.
    infinity_norm_mean, infinity_norm_max : (q,) array
        Largest deviation of each pair: its mean and maximum over the pairs, in the units of the outputs.
    worst : tuple of WorstPair
        For each output the pairs with the poorest fit, the poorest first.
    points : tuple of PointSummary
        Summaries by operating point of the recordings, by rising pressure, then speed.
    failed : tuple of str
        Pairs that could not be validated, with the reason.
    """

    n_pairs: int
    n_models: int
    n_recordings: int
    output_names: Annotated[tuple[str, ...], Stored(shape="q")]
    output_units: Annotated[tuple[str, ...], Stored(shape="q")]
    mean: Annotated[FloatArray, Stored("%", "mean of the fit percent, outputs", "q")]
    std: Annotated[FloatArray, Stored("%", "standard deviation of the fit percent", "q")]
    median: Annotated[FloatArray, Stored("%", "median of the fit percent", "q")]
    least: Annotated[FloatArray, Stored("%", "smallest fit percent", "q")]
    greatest: Annotated[FloatArray, Stored("%", "largest fit percent", "q")]
    edges: Annotated[FloatArray, Stored("%", "edges of the histograms, outputs by bins + 1", "q edges")]
    counts: Annotated[IntArray, Stored("1", "pairs in each bin, outputs by bins", "q bins")]
    below: Annotated[IntArray, Stored("1", "pairs below the first edge", "q")]
    infinity_norm_mean: Annotated[
        FloatArray, Stored("as attribute output_units", "mean of the largest deviations", "q")
    ]
    infinity_norm_max: Annotated[FloatArray, Stored("as attribute output_units", "largest deviation of all pairs", "q")]
    worst: tuple[WorstPair, ...]
    points: tuple[PointSummary, ...]
    failed: tuple[str, ...] = ()
    FILE: ClassVar[hdf5.FileKind] = hdf5.FileKind("validation_summary", "make it again with `gbid crossval`")

    def _brief(self) -> Description:
        outputs = {
            name: f"{self.mean[j]:.2f} +- {self.std[j]:.2f} %, {self.least[j]:.2f} to {self.greatest[j]:.2f} %"
            for j, name in enumerate(self.output_names)
        }
        about = f"{self.n_pairs} pairs, {self.n_models} models on {self.n_recordings} recordings"
        return brief(self, about, **outputs, failed=self.failed)

    def document(self) -> Row:
        """Return the summary as plain values, with histograms, for JSON."""
        return asdict(self)

    def tables(self) -> list[Table]:
        """Return the table of the fit percent of each output, overall and by operating point."""
        columns = [
            *(Column(""), Column("output"), Column("pairs", format="d")),
            *(Column("fit\n", "%", ".2f"), Column("std\n", "%", ".2g"), Column("least\n", "%", ".2f")),
            *(Column("largest\nerror", format=2), Column("worst pair", wrap=True)),
        ]
        worst = {pair.output: pair for pair in reversed(self.worst)}
        places: list[tuple[str, ValidationSummary | PointSummary, FloatArray]] = [("all", self, self.infinity_norm_max)]
        if 1 < len(self.points) <= _SHOWN_POINTS:
            places += [(point_label(q.pressure_bar, q.speed_rpm), q, q.infinity_norm) for q in self.points]
        rows: list[list[Entry]] = []
        for place, figures, largest in places:
            for j, (output, unit) in enumerate(zip(self.output_names, self.output_units, strict=True)):
                pair = worst.get(output) if figures is self else None
                numbers = (figures.n_pairs, float(figures.mean[j]), float(figures.std[j]))
                least = float(self.least[j]) if figures is self else ""
                shown = Cell(pair.model, f"{pair.model} on {pair.recording}") if pair else ""
                rows.append(["" if j else place, output, *numbers, least, formatted(largest[j], 2, unit), shown])
        title = f"cross-validation: {self.n_models} models, {self.n_recordings} recordings, {self.n_pairs} pairs"
        return [Table(title, columns, rows, [f"failed: {text}" for text in self.failed])]

    def figures(self) -> list[Figure]:
        """Return histograms of the fit percent over all pairs of model and recording; none for few pairs."""
        means = "; ".join(f"{o} {m:.2f} %" for o, m in zip(self.output_names, self.mean, strict=True))
        caption = f"Histograms of the cross-validation fit, means {means}"
        return [Figure("plot_fit_histogram", caption, (self,))] if self.n_pairs >= _FEWEST_DRAWN else []


def join_scores(pairs: Sequence[tuple[str, ValidationData, FloatArray, FloatArray]]) -> ValidationScores:
    """Return the scores of single pairs as one table.

    Parameters
    ----------
    pairs : sequence of (model, data, fit_percent, infinity_norm)
        At least one.
    """
    first = pairs[0][1]
    return ValidationScores(
        tuple(model for model, *_ in pairs),
        tuple(data.name for _, data, *_ in pairs),
        np.array([data.conditions.get("pressure_bar", np.nan) for _, data, *_ in pairs]),
        np.array([data.conditions.get("speed_rpm", np.nan) for _, data, *_ in pairs]),
        first.output_names,
        first.output_units,
        np.array([fit for _, _, fit, _ in pairs]).reshape(len(pairs), -1),
        np.array([norm for *_, norm in pairs]).reshape(len(pairs), -1),
    )


def summarise(
    scores: ValidationScores, *, bins: Count = 20, worst: CountOrZero = 3, failed: Iterable[str] = ()
) -> ValidationSummary:
    """Return the summary of a cross-validation: mean, standard deviation, histogram and poorest pairs of each output.

    The histogram of an output covers its fits, but not more than six robust standard deviations below the median.
    Otherwise one failed model would put all others into one bin. The fits below the histogram are counted.

    Parameters
    ----------
    scores : ValidationScores
        Scores of all pairs.
    bins : int
        Number of bins of each histogram.
    worst : int
        Number of poorest pairs to list for each output.
    failed : iterable of str
        Pairs that could not be validated, with the reason.

    Returns
    -------
    ValidationSummary

    Raises
    ------
    DataError
        When there is no pair.
    UsageError
        When `bins` is below one or `worst` is negative.
    """
    if not len(scores):
        raise DataError("no pair of model and recording was validated, so there is nothing to summarise")
    fit, norm = scores.fit_percent, scores.infinity_norm
    edges = np.array([_edges(column, bins) for column in fit.T])
    counts = np.array([np.histogram(column, edge)[0] for column, edge in zip(fit.T, edges, strict=True)])
    below = (fit < edges[:, 0]).sum(axis=0)
    named = [
        WorstPair(scores.models[i], scores.recordings[i], output, float(fit[i, j]), float(norm[i, j]))
        for j, output in enumerate(scores.output_names)
        for i in np.argsort(fit[:, j], kind="stable")[:worst]
    ]
    return ValidationSummary(
        n_pairs=len(scores),
        n_models=len(set(scores.models)),
        n_recordings=len(set(scores.recordings)),
        output_names=scores.output_names,
        output_units=scores.output_units,
        mean=fit.mean(axis=0),
        std=_std(fit),
        median=np.median(fit, axis=0),
        least=fit.min(axis=0),
        greatest=fit.max(axis=0),
        edges=edges,
        counts=counts.astype(np.int64),
        below=below.astype(np.int64),
        infinity_norm_mean=norm.mean(axis=0),
        infinity_norm_max=norm.max(axis=0),
        worst=tuple(named),
        points=tuple(_points(scores)),
        failed=tuple(failed),
    )


def _edges(fit: FloatArray, bins: int) -> FloatArray:
    low, high, median = float(fit.min()), float(fit.max()), float(np.median(fit))
    reach = 6 * 1.4826 * float(np.median(np.abs(fit - median)))
    low = max(low, median - reach) if reach > 0 else low
    if not high - low > 1e-9 * max(1.0, abs(high)):
        low, high = high - 0.5, high + 0.5
    return np.linspace(low, high, bins + 1)


def _std(fit: FloatArray) -> FloatArray:
    return np.asarray(fit.std(axis=0, ddof=1)) if len(fit) > 1 else np.full(fit.shape[1], np.nan)


def _points(scores: ValidationScores) -> Iterable[PointSummary]:
    places = np.column_stack([scores.pressure_bar, scores.speed_rpm])
    known = np.nan_to_num(places, nan=np.inf)  # nan is not equal to itself
    for point in np.unique(known, axis=0):
        rows = (known == point).all(axis=1)
        fit, (pressure, speed) = scores.fit_percent[rows], places[rows][0].tolist()
        largest = scores.infinity_norm[rows].max(axis=0)
        yield PointSummary(pressure, speed, len(fit), fit.mean(axis=0), _std(fit), largest)


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
        Outputs, also at samples that do not count for the figures above; measured ones are NaN where they are missing.
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

    drawn_by = "plot_response"

    def _brief(self) -> Description:
        figures = {
            name: f"fit {self.fit_percent[j]:.2f} %, largest deviation {self.infinity_norm[j]:.4g} {unit}".rstrip()
            for j, (name, unit) in enumerate(zip(self.output_names, self.output_units, strict=True))
        }
        about = f"model of {', '.join(self.fitted_to)} on {self.recording}, {len(self.time)} samples"
        return brief(self, about, **figures, conditions=self.conditions)

    def to_frame(self) -> Any:
        """Return a data frame of inputs, measured and simulated outputs, indexed by time.

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
        When the recording lacks a signal or has another sample time, when no sample counts, when the simulation
        overflows, or when the model is unstable and would grow by more than 1000 over the recording.
    """
    data = validation_data(result, recording, left_out)
    fitted = at_clock_of(simulator(result), data.clock)
    explained = _explain(fitted, data)
    simulated = fitted.run(data.inputs, explained.initial_state)
    simulated = simulated + fitted.disturbed(data.outputs - simulated, data.counted)
    percent, largest = _figures(explained, data)
    return Validation(
        recording=data.name,
        fitted_to=result.recordings,
        fit_percent=percent,
        infinity_norm=largest,
        measured=select(recording, result.options.outputs, gaps=True, irregular=True)[0],
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
    """Return the scores of many models on many recordings; see `cross_validate`.

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
    scores = [(i, j, *score(fitted[i], data[j])) for i, j in pairs]
    return join_scores([(" ".join(results[i].recordings), data[j], fit, norm) for i, j, fit, norm in scores])


def score(fitted: Simulator, data: ValidationData) -> tuple[FloatArray, FloatArray]:
    """Return fit percent and largest deviation of one model on one recording.

    Returns
    -------
    fit_percent, infinity_norm : (n_outputs,) array
        Fit in percent, and largest deviation in the units of the outputs.

    Raises
    ------
    DataError
        When model and recording do not fit together, or when the simulation overflows or the model is unstable.
    """
    return _figures(_explain(fitted, data), data)


def _figures(explained: Explained, data: ValidationData) -> tuple[FloatArray, FloatArray]:
    rest = explained.residuals
    error = np.sqrt(np.einsum("ik,ik->i", rest, rest))
    return 100 * (1 - error / data.spread), np.abs(rest).max(axis=1)


_GROWTH = 1e3  # over a recording: what is known to a thousandth of an output is as large as the output in the end


def _explain(fitted: Simulator, data: ValidationData) -> Explained:
    fitted = at_clock_of(fitted, data.clock)
    model = fitted.model
    if not np.allclose(data.clock, fitted.sample_time, rtol=1e-6, atol=0):
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
    grown = fitted.rate * data.sample_time * data.inputs.shape[1]
    if grown > log(_GROWTH):
        raise DataError(
            f"the model of {fitted.name} is unstable: not simulated on recording {data.name!r}, where it would grow "
            f"by a factor of 1e{grown / log(10):.0f}; test its predictions (check_residuals), or validate the loop "
            "that keeps it stable (ClosedLoop)"
        )
    explained = fitted.explain(data.inputs, data.outputs, data.counted)
    if not np.isfinite(explained.residuals).all():
        raise DataError(
            f"the model of {fitted.name} overflows on recording {data.name!r}; "
            "it is unstable: fit it again from another start, or leave it out"
        )
    return explained
