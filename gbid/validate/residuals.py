"""Residual tests of a fitted model (paper, Sec. 3.8), and shaft lines in its residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Pictured
from gbid.identify import FitResult
from gbid.identify.data import select
from gbid.identify.uncertainty.residual_tests import correlation, input_test, whiteness_test
from gbid.prefilter.runout import turns_per_second
from gbid.prefilter.runout_identification import power_of
from gbid.recording import Recording
from gbid.validate.simulate import (
    NonlinearSimulator,
    Ranges,
    counted_samples,
    fit_percent,
    refuse_scheduled,
    simulator_of,
)

_LEVEL = 0.99
_LAGS = 50  # largest lag that is tested, by default


@dataclass(frozen=True, eq=False)
class ResidualTest(Brief, Pictured):
    """Whiteness test of residuals, and test of their correlation with the inputs.

    Attributes
    ----------
    recording : str
        Name of the recording.
    lags : (n_lags + 1,) integer array
        Lags from 0 [samples].
    time : (n_lags + 1,) array
        Lags [s].
    autocorrelation : (n_outputs, n_lags + 1) array
        Autocorrelation of the residuals.
    band : float
        99 % of the autocorrelations of white residuals lie within plus and minus this value.
    cross_lags : (2 n_lags + 1,) integer array
        Lags of the residual behind the input [samples]; correlation at negative lags indicates feedback.
    crosscorrelation : (n_outputs, n_inputs, 2 n_lags + 1) array
        Cross-correlation of residuals and inputs.
    cross_band : (n_outputs, n_inputs) array
        99 % of the cross-correlations lie within plus and minus this value when residuals and inputs are independent.
        It takes the colour of both into account.
    p_white : (n_outputs,) array
        p-value of the hypothesis that the residuals are white (Ljung-Box).
    p_independent : (n_outputs, n_inputs) array
        p-value of the hypothesis that the residuals are independent of the input, over all lags from 0 together.
    outside : (n_outputs, n_inputs) array
        Share of the lags from 0 whose cross-correlation lies outside its band; about 0.01 by chance.
    infinity_norm : (n_outputs,) array
        Largest residual, in the units of the outputs.
    rms : (n_outputs,) array
        Root mean square of the residuals, in the units of the outputs.
    fit_percent : (n_outputs,) array
        Fit percent of the predictions (or simulations) that have these residuals.
    input_names, output_names : tuple of str
        Names of the channels.
    """

    recording: str
    lags: IntArray
    time: FloatArray
    autocorrelation: FloatArray
    band: float
    cross_lags: IntArray
    crosscorrelation: FloatArray
    cross_band: FloatArray
    p_white: FloatArray
    p_independent: FloatArray
    outside: FloatArray
    infinity_norm: FloatArray
    rms: FloatArray
    fit_percent: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]

    drawn_by = "plot_residuals"

    def _brief(self) -> Description:
        return brief(
            self,
            f"residuals on {self.recording}, {len(self.lags) - 1} lags",
            verdict="; ".join(self.verdict),
            p_white=dict(zip(self.output_names, self.p_white.tolist(), strict=True)),
            rms=dict(zip(self.output_names, self.rms.tolist(), strict=True)),
            fit_percent=self.fit_percent,
        )

    @property
    def white(self) -> BoolArray:
        """Whether the residuals of each output count as white, (n_outputs,)."""
        return np.asarray(self.p_white >= (1 - _LEVEL) / len(self.p_white))

    @property
    def follows(self) -> tuple[tuple[str, ...], ...]:
        """Inputs that are correlated with the residuals of each output."""
        return tuple(
            tuple(name for name, p in zip(self.input_names, row, strict=True) if p < 1 - _LEVEL)
            for row in self.p_independent
        )

    @property
    def verdict(self) -> tuple[str, ...]:
        """Results of the tests as sentences."""
        sentences = []
        for output, white, p, inputs in zip(self.output_names, self.white, self.p_white, self.follows, strict=True):
            sentences.append(f"{output}: residuals {'white' if white else 'not white'} (p = {p:.2g})")
            if inputs:
                sentences.append(f"{output}: residuals still follow {', '.join(inputs)}: the structure is incomplete")
        return tuple(sentences)


def check_residuals(
    result: FitResult, recording: Recording, lags: int | None = None, left_out: Ranges = ()
) -> ResidualTest:
    """Return residual tests of a fitted model on a recording.

    The residuals are one-step-ahead prediction errors for a fit with prediction focus, and simulation errors
    otherwise. The initial state is estimated on the recording. Bartlett's formula gives the covariance of the
    cross-correlations from the colour of residual and input. For a slow input the values at neighbouring lags are
    almost equal, and the test takes this into account.

    Parameters
    ----------
    result : FitResult
        The fit.
    recording : Recording
        The recording.
    lags : int, optional
        Largest lag [samples]; by default 50, or a fourth of the samples that are tested.
    left_out : sequence of (start, stop)
        Ranges of samples that are not tested. The longest stretch without them is tested, because correlations need
        consecutive samples. Where outputs are missing (nan), a simulation goes on; its residuals count at the samples
        that have all outputs, and each correlation is that of the pairs there are. A prediction needs every output:
        its longest stretch has none missing.

    Returns
    -------
    ResidualTest

    Raises
    ------
    UsageError
        When the recording is shorter than four times the lags.
    DataError
        When the recording lacks a signal, when no four samples in a row can be tested, or when the predictions
        overflow.
    """
    refuse_scheduled(result)
    u, input_names, _ = select(recording, result.options.inputs, irregular=True)
    output_names = select(recording, result.options.outputs, gaps=True, irregular=True)[1]
    stretch, counted = _tested(result, recording, left_out)
    u = u[stretch]
    if len(u) < 4:
        raise DataError(
            f"recording {recording.name!r}: no four samples in a row have all outputs, and residuals of a fit in "
            "prediction focus need them; fit in simulation focus, or write residuals: none"
        )
    lags = min(_LAGS, len(u) // 4) if lags is None else lags
    if lags < 1 or len(u) < 4 * lags:
        raise UsageError(
            f"lags = {lags}: recording {recording.name!r} has {len(u)} samples; lags must be 1 to a fourth"
        )
    y, predicted = _predicted(result, recording, stretch, counted)
    error = y[counted] - predicted[counted]
    e, v = np.zeros_like(y), u - u.mean(0)  # zero where there is no residual: it is in no sum
    e[counted] = error - error.mean(0)
    quantile = float(scipy.special.ndtri(0.5 + _LEVEL / 2))
    test = input_test(e, u, lags)
    n, pairs = len(e), list(np.ndindex(test.statistic.shape))
    before = np.array([correlation(e[:, j], v[:, i], lags)[:0:-1] for j, i in pairs])
    cross = np.concatenate([before.reshape(*test.statistic.shape, lags), test.correlation], axis=2)
    band = quantile * np.sqrt(test.variance[:, :, 0] / n)
    outside = (np.abs(cross[:, :, lags:]) > band[:, :, None]).mean(axis=2)
    white = whiteness_test([e])
    return ResidualTest(
        recording=recording.name,
        lags=np.arange(lags + 1),
        time=np.asarray(recording.sample_time * np.arange(lags + 1), np.float64),
        autocorrelation=np.array([correlation(channel, channel, lags) for channel in e.T]),
        band=quantile / float(np.sqrt(counted.sum())),
        cross_lags=np.arange(-lags, lags + 1),
        crosscorrelation=cross,
        cross_band=band,
        p_white=white.p_value,
        p_independent=test.p_value,
        outside=outside,
        infinity_norm=np.abs(error).max(axis=0),
        rms=np.sqrt((error**2).mean(axis=0)),
        fit_percent=fit_percent(y[counted], predicted[counted]),
        input_names=tuple(input_names),
        output_names=tuple(output_names),
    )


def _tested(result: FitResult, recording: Recording, left_out: Ranges) -> tuple[slice, BoolArray]:
    """Return the tested stretch of the residuals, and its samples that have all outputs."""
    missing = np.isnan(select(recording, result.options.outputs, gaps=True, irregular=True)[0])
    whole = np.asarray(~missing.any(axis=1), bool)
    counted = counted_samples(recording, left_out)
    tested = np.ones(len(whole), bool) if counted is None else counted
    if result.options.focus == "prediction":
        tested = tested & whole
    edges = np.flatnonzero(np.diff(tested, prepend=False, append=False)).reshape(-1, 2)
    start, stop = edges[np.argmax(edges[:, 1] - edges[:, 0])].tolist() if len(edges) else (0, 0)
    return slice(start, stop), whole[start:stop]


def _predicted(
    result: FitResult, recording: Recording, stretch: slice, counted: BoolArray, known_state: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return outputs without trends and hum, and their predictions, at the samples that count.

    A known initial state is that of the stretch in a prediction without disturbances.
    """
    u = select(recording, result.options.inputs, irregular=True)[0][stretch]
    y = select(recording, result.options.outputs, gaps=True, irregular=True)[0][stretch]
    clock = recording.sample_time if recording.stamps is None else recording.stamps[stretch]
    model, some = result.model, None if counted.all() else counted
    overflow = DataError(f"the predictor of {', '.join(result.recordings)} overflows on recording {recording.name!r}")
    with np.errstate(over="ignore", invalid="ignore"):
        disturbances = result.disturbances
        if known_state is not None:
            return y, model.predict(u, y, clock, initial_state=known_state)
        fitted = simulator_of(model, clock, disturbances=disturbances)
        if isinstance(fitted, NonlinearSimulator) and result.options.focus == "prediction":
            fitted = replace(
                fitted, predicts=bool(fitted.model.K.any()) and not disturbances.instead_of_walks(1).n_columns
            )
        state = fitted.explain(u.T, y.T, some).initial_state
        if not np.isfinite(state).all():
            raise overflow
        predicted = fitted.run(u.T, state).T
        y = y - fitted.disturbed((y - predicted).T, some).T
        if result.options.focus == "prediction":
            model = disturbances.with_walks_as_states(model, result.parameters)
            state = np.concatenate([state, np.zeros(len(disturbances.walking))])
            predicted = model.predict(u, y, clock, initial_state=state)
    if not np.isfinite(predicted).all():
        raise overflow
    return y, predicted


# ---- Shaft lines in the residuals of a fit: run-out that the prefilter did not remove.

CLEAR = 30.0
"""A line counts when its power is this many times the usual power beside it. Of 50 lines in noise, none does with a
probability of more than 0.999."""
MOST = 50
"""Largest order that is looked at."""


class ShaftLine(NamedTuple):
    """Spectral line at a multiple of the shaft frequency.

    Attributes
    ----------
    output : str
        Name of the output.
    order : int
        Multiple of the shaft frequency.
    frequency_hz : float
        Frequency.
    rms : float
        Size, in the unit of the output.
    """

    output: str
    order: int
    frequency_hz: float
    rms: float


def shaft_lines(result: FitResult, recording: Recording, left_out: Ranges = ()) -> list[ShaftLine]:
    """Return the largest significant shaft line in the residuals of each output.

    Parameters
    ----------
    result : FitResult
        The fit.
    recording : Recording
        A recording of it, with the shaft angle phi.
    left_out : sequence of (start, stop)
        Ranges of samples that do not count.

    Returns
    -------
    list of ShaftLine
        Empty for a shaft at rest, without phi, where outputs of a simulation are missing, at irregular times, and for
        less than a turn.

    Raises
    ------
    DataError
        When the recording lacks a signal, or when the predictions overflow.
    """
    turning = turns_per_second(recording)
    if turning is None or recording.stamps is not None:
        return []
    names = select(recording, result.options.outputs, gaps=True)[1]
    stretch, counted = _tested(result, recording, left_out)
    if not counted.all() or len(counted) * recording.sample_time * turning < 1:  # gaps have lines of their own
        return []
    plain = result.options.focus == "prediction" and not result.disturbances.instead_of_walks(1).n_columns
    state = result.initial_states[result.recordings.index(recording.name)] if plain and stretch.start == 0 else None
    y, predicted = _predicted(result, recording, stretch, counted, state)
    error = y - predicted
    power, frequency = power_of(error - error.mean(axis=0), recording.sample_time)
    clear = []
    for j, name in enumerate(names):
        lines = _lines(power[:, j], frequency, turning)
        if lines:
            order, rms = max(lines, key=lambda line: line[1])
            clear.append(ShaftLine(name, order, order * turning, rms))
    return clear


def _lines(power: FloatArray, frequency: FloatArray, turning: float) -> list[tuple[int, float]]:
    """Return order and rms of the significant shaft lines."""
    step = frequency[0]
    lines = []
    for order in range(1, min(MOST, int(frequency[-1] / turning)) + 1):
        at = round(order * turning / step) - 1
        width = max(8, round(0.4 * turning / step))
        near = power[max(0, at - 2) : at + 3]
        beside = np.concatenate([power[max(0, at - width) : max(0, at - 2)], power[at + 3 : at + 3 + width]])
        beside.sort()
        middle = beside[(beside.size - 1) // 2 : beside.size // 2 + 1]
        # The usual power of a periodogram: its median over ln 2, because it is chi-square with two degrees of freedom.
        usual = float(middle.mean()) / np.log(2) if beside.size else np.inf
        if near.size and near.max() > CLEAR * usual:
            lines.append((order, float(np.sqrt(near.sum()))))
    return lines
