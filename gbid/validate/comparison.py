"""Comparison of models on the same recordings: fit percent, information criterion, whiteness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbid.core.arrays import FloatArray
from gbid.core.brief import Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.tables import Column, Entry, Table
from gbid.identify import FitResult
from gbid.identify.data import select
from gbid.identify.uncertainty.curves import Tabled
from gbid.identify.uncertainty.residual_tests import whiteness_test
from gbid.recording import Recording
from gbid.structure import LinearModel
from gbid.structure.linear import as_names
from gbid.validate.simulate import at_clock_of, fit_percent, refuse_scheduled, simulator, simulator_of

Models = LinearModel | FitResult | Sequence[LinearModel | FitResult] | Mapping[str, LinearModel | FitResult]


@dataclass(frozen=True, eq=False)
class ModelComparison(Tabled, Pictured):
    """Comparison of several models on the same recordings; `gbid.compare` makes it.

    Attributes
    ----------
    models : dict of str to LinearModel or FitResult
        The models.
    recordings, outputs : tuple of str
        Names of the recordings and of the output channels that all models have.
    orders : (n_models,) integer array
        Numbers of states.
    parameters : (n_models,) integer array
        Numbers of estimated parameters; of a model without structure those that its response has.
    fit_percent : (n_models, n_recordings, n_outputs) array
        ``100 (1 - |y - yhat| / |y - mean y|)`` of simulations whose initial state is estimated on the recording. A
        plain model is one of deviations from the means; a fit has the trend that it was fitted with.
    aic : (n_models,) array
        Akaike's information criterion of these simulations; the smallest is the best. It counts the errors as white.
    whiteness : (n_models, n_outputs) array
        p-value of the whiteness test of their errors (Ljung-Box).
    """

    models: Mapping[str, LinearModel | FitResult]
    recordings: tuple[str, ...]
    outputs: tuple[str, ...]
    orders: FloatArray
    parameters: FloatArray
    fit_percent: FloatArray
    aic: FloatArray
    whiteness: FloatArray

    def _brief(self) -> Description:
        means = self.fit_percent.mean(axis=(1, 2))
        each = [
            f"{name}: {int(order)} states, {int(count)} parameters, {mean:.2f} %, AIC {aic:.6g}"
            for name, order, count, mean, aic in zip(
                self.models, self.orders, self.parameters, means, self.aic, strict=True
            )
        ]
        return brief(self, f"{len(self.models)} models on {', '.join(self.recordings)}", models=each)

    def figures(self) -> list[Figure]:
        """Return the frequency responses of the models; models with equal channels share a figure."""
        groups: dict[tuple[tuple[str, ...], ...], dict[str, LinearModel | FitResult]] = {}
        for name, model in self.models.items():
            linear = model.linear_model if isinstance(model, FitResult) else model
            groups.setdefault((linear.input_names, linear.output_names), {})[name] = model
        return [Figure("plot_bode", f"Frequency responses of {', '.join(q)}", (q,)) for q in groups.values()]

    def table(self) -> Table:
        """Return a table with a row for each model and output, with the smallest fit percent of all recordings."""
        columns = [Column(name) for name in ("model", "output", "states", "parameters")]
        columns += [Column(name, format=5) for name in ("fit [%]", "least fit [%]")]
        columns += [Column("AIC", format=7), Column("p white", format=2)]
        rows: list[list[Entry]] = [
            [
                name,
                output,
                int(self.orders[i]),
                int(self.parameters[i]),
                float(self.fit_percent[i, :, j].mean()),
                float(self.fit_percent[i, :, j].min()),
                float(self.aic[i]),
                float(self.whiteness[i, j]),
            ]
            for i, name in enumerate(self.models)
            for j, output in enumerate(self.outputs)
        ]
        return Table("comparison of models", columns, rows)


def compare(
    models: Models,
    recordings: Recording | Sequence[Recording],
    *,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
) -> ModelComparison:
    """Return a comparison of models on the same recordings, for the outputs that all models have.

    Parameters
    ----------
    models : LinearModel or FitResult, sequence of them, or dict of str to them
        The models. Plain ones have the name of the model, or its number where names are alike.
    recordings : Recording or sequence of Recording
        Recordings, best such that no model was estimated from.
    inputs, outputs : str or sequence of str, optional
        Signals (``"p"``) or channels (``"p.x"``) of all models. By default each fit has its own, and each plain model
        the channels that it names, or those of the first fit.

    Returns
    -------
    ModelComparison
        Its ``table()`` has a row for each model, its ``plot()`` their frequency responses.

    Raises
    ------
    UsageError
        When there is no model, a model is scheduled, no signals are known, or the models have no output in common.
    DataError
        When a recording lacks a signal, or a model is unstable and cannot be simulated over a recording.
    """
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    named = _named(models)
    if not named or not several:
        raise UsageError("compare needs at least one model and one recording")
    scores_of = {
        name: [
            as_names(given) if given is not None else _signals(model, list(named.values()), kind, several[0])
            for kind, given in (("inputs", inputs), ("outputs", outputs))
        ]
        for name, model in named.items()
    }
    labels_of = {name: select(several[0], signals[1])[1] for name, signals in scores_of.items()}
    shared = tuple(label for label in next(iter(labels_of.values())) if all(label in q for q in labels_of.values()))
    if not shared:
        each = "; ".join(f"{name!r} has {', '.join(labels)}" for name, labels in labels_of.items())
        raise UsageError(f"the models have no output in common: {each}")
    n_y, n = len(shared), sum(each.n_samples for each in several)
    percent = np.zeros((len(named), len(several), n_y))
    aic, white, orders, counts = np.zeros(len(named)), np.zeros((len(named), n_y)), [], []
    for i, (name, model) in enumerate(named.items()):
        columns = [labels_of[name].index(label) for label in shared]
        linear = model.linear_model if isinstance(model, FitResult) else model
        errors = []
        for k, recording in enumerate(several):
            y, residuals = _simulated(name, model, recording, scores_of[name])
            percent[i, k] = fit_percent(y, y - residuals)[columns]
            errors.append(residuals[:, columns])
        orders.append(linear.n_states)
        counts.append(len(model.free) if isinstance(model, FitResult) else _freedom(linear))
        white[i] = whiteness_test(errors).p_value
        products = np.asarray(sum(e.T @ e for e in errors)) / n
        aic[i] = n * (np.linalg.slogdet(products)[1] + n_y * (1 + np.log(2 * np.pi))) + 2 * counts[-1]
    names = tuple(each.name for each in several)
    return ModelComparison(named, names, shared, np.array(orders), np.array(counts), percent, aic, white)


def _simulated(
    name: str, model: LinearModel | FitResult, recording: Recording, signals: Sequence[Sequence[str]]
) -> tuple[FloatArray, FloatArray]:
    """Return measured outputs and simulation errors of a model on a recording, both (n_samples, n_y)."""
    u, y = (select(recording, each)[0] for each in signals)
    if isinstance(model, FitResult):
        refuse_scheduled(model)
        linear, runner = model.linear_model, at_clock_of(simulator(model), recording.sample_time)
    else:
        linear, runner = model, simulator_of(model, recording.sample_time)
        u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    if linear.D.shape != (y.shape[1], u.shape[1]):
        raise UsageError(
            f"model {name!r} has {linear.D.shape[0]} outputs and {linear.D.shape[1]} inputs, the signals "
            f"{', '.join(signals[0])} and {', '.join(signals[1])} have {y.shape[1]} and {u.shape[1]}"
        )
    residuals = runner.explain(np.ascontiguousarray(u.T), np.ascontiguousarray(y.T)).residuals.T
    if not np.isfinite(residuals).all():
        raise DataError(f"model {name!r} overflows when it is simulated on {recording.name!r}: it is unstable")
    return y, residuals


def _named(models: Models) -> dict[str, LinearModel | FitResult]:
    """Return the models by name."""
    if isinstance(models, Mapping):
        return dict(models)
    several = [models] if isinstance(models, LinearModel | FitResult) else list(models)
    names = [each.structure if isinstance(each, FitResult) else each.name for each in several]
    return {
        name if names.count(name) == 1 else f"{name} {i}": each
        for i, (name, each) in enumerate(zip(names, several, strict=True), 1)
    }


def _signals(
    model: LinearModel | FitResult, models: Sequence[LinearModel | FitResult], kind: str, recording: Recording
) -> tuple[str, ...]:
    """Return the signals of a fit; for a plain model its channels, else the signals of the first fit."""
    if isinstance(model, FitResult):
        return tuple(getattr(model.options, kind))
    wanted = getattr(model, "input_names" if kind == "inputs" else "output_names")
    channels = {label: name for name in recording.signals for label, name in _labels(recording, name)}
    missing = [label for label in wanted if label not in channels]
    if not missing:
        return tuple(channels[label] for label in wanted)
    if fit := next((each for each in models if isinstance(each, FitResult)), None):
        return tuple(getattr(fit.options, kind))
    raise UsageError(
        f"recording {recording.name!r} has no channels {', '.join(missing)}, which the model names; give {kind}=..."
    )


def _labels(recording: Recording, signal: str) -> list[tuple[str, str]]:
    """Return for each channel of a signal its name in models and its name in a recording."""
    channels = recording.channels[signal]
    labels = [f"{signal}.{channel}" for channel in channels] if len(channels) > 1 else [signal]
    return list(zip(select(recording, (signal,))[1], labels, strict=True))


def _freedom(model: LinearModel) -> int:
    """Return the number of free parameters of the transfer function of a model without structure."""
    n, (n_y, n_u) = model.n_states, model.D.shape
    return int(n * (n_y + n_u) + (n_y * n_u if model.D.any() else 0))
