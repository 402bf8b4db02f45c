"""What the residuals of a fit say about it: paper, Sec. 3.8."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from gbid.errors import UsageError
from gbid.identify import FitResult, correlation, select, whiteness_test
from gbid.recording import Recording
from gbid.validate.crossval import estimate_initial_state
from gbid.validate.fit_percent import fit_percent

FloatArray = npt.NDArray[np.float64]
_LEVEL = 0.99


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """Whiteness of residuals, and what is left in them of the inputs.

    Attributes
    ----------
    recording : str
    lags : (n_lags + 1,) integer array
        From 0 [samples].
    time : (n_lags + 1,) array
        The same [s].
    autocorrelation : (n_outputs, n_lags + 1) array
    band : float
        99 % of the autocorrelations of white residuals lie within plus and minus this.
    cross_lags : (2 n_lags + 1,) integer array
        Lags of the residual behind the input; negative ones would be feedback.
    crosscorrelation : (n_outputs, n_inputs, 2 n_lags + 1) array
    cross_band : (n_outputs, n_inputs) array
        The same for residuals independent of the inputs, which allows for the colour of both.
    p_white : (n_outputs,) array
        Probability of less white residuals if they were white (Ljung-Box).
    outside : (n_outputs, n_inputs) array
        Share of lags from 0 on whose cross-correlation lies outside its band; about 0.01 by chance.
    infinity_norm : (n_outputs,) array
        Largest residual, in the outputs' units.
    rms : (n_outputs,) array
    fit_percent : (n_outputs,) array
        Of the predictions whose errors these residuals are.
    input_names, output_names : tuple of str
    verdict : tuple of str
        The findings in words.
    """

    recording: str
    lags: npt.NDArray[np.int64]
    time: FloatArray
    autocorrelation: FloatArray
    band: float
    cross_lags: npt.NDArray[np.int64]
    crosscorrelation: FloatArray
    cross_band: FloatArray
    p_white: FloatArray
    outside: FloatArray
    infinity_norm: FloatArray
    rms: FloatArray
    fit_percent: FloatArray
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    verdict: tuple[str, ...]


def check_residuals(result: FitResult, recording: Recording, lags: int = 50) -> ResidualTest:
    """Test the residuals of a fitted model on a recording.

    One-step-ahead errors for a fit with prediction focus, errors of simulation otherwise, the initial state
    estimated on the recording. The inputs are whitened together with the residuals' test band by Bartlett's
    formula, so that a slow input does not make correlations look significant that are not.

    Parameters
    ----------
    result : FitResult
    recording : Recording
    lags : int
        Largest lag [samples].

    Returns
    -------
    ResidualTest

    Raises
    ------
    UsageError
        When the recording is shorter than four times the lags.
    """
    inputs, outputs = result.options["inputs"].split(), result.options["outputs"].split()
    u, input_names, _ = select(recording, inputs)
    y, output_names, _ = select(recording, outputs)
    if lags < 1 or len(y) < 4 * lags:
        raise UsageError(
            f"lags = {lags}: recording {recording.name!r} has {len(y)} samples; lags must be 1 to a fourth"
        )
    hold = result.options["intersample"].split()
    between: str | list[str] = hold[0] if len(hold) == 1 else hold
    model = result.model
    state = estimate_initial_state(model, u, y, recording.sample_time, between)
    if result.options["focus"] == "prediction":
        predicted = model.predict(u, y, recording.sample_time, initial_state=state, intersample=between)
    else:
        predicted = model.simulate(u, recording.sample_time, initial_state=state, intersample=between)
    error = y - predicted
    e, v = error - error.mean(0), u - u.mean(0)
    n, n_y, n_u = len(e), e.shape[1], v.shape[1]
    quantile = float(norm.ppf(0.5 + _LEVEL / 2))
    auto = np.array([correlation(e[:, j], e[:, j], lags) for j in range(n_y)])
    cross = np.zeros((n_y, n_u, 2 * lags + 1))
    band = np.zeros((n_y, n_u))
    for j in range(n_y):
        for i in range(n_u):
            ahead = correlation(v[:, i], e[:, j], lags)
            behind = correlation(e[:, j], v[:, i], lags)
            cross[j, i] = np.concatenate([behind[:0:-1], ahead])
            band[j, i] = quantile * np.sqrt(_bartlett(e[:, j], v[:, i]) / n)
    outside = (np.abs(cross[:, :, lags:]) > band[:, :, None]).mean(axis=2)
    white = whiteness_test([error])
    return ResidualTest(
        recording=recording.name,
        lags=np.arange(lags + 1),
        time=recording.time[: lags + 1],
        autocorrelation=auto,
        band=quantile / float(np.sqrt(n)),
        cross_lags=np.arange(-lags, lags + 1),
        crosscorrelation=cross,
        cross_band=band,
        p_white=white.p_value,
        outside=outside,
        infinity_norm=np.abs(error).max(axis=0),
        rms=np.sqrt((error**2).mean(axis=0)),
        fit_percent=fit_percent(y, predicted),
        input_names=tuple(input_names),
        output_names=tuple(output_names),
        verdict=_verdict(white.p_value, outside, input_names, output_names),
    )


def _bartlett(a: FloatArray, b: FloatArray) -> float:
    """Sum over all lags of the product of two autocorrelations: variance of their cross-correlation times n."""
    most = min(len(a) // 4, 2000)
    product = correlation(a, a, most) * correlation(b, b, most)
    return max(float(product[0] + 2 * product[1:].sum()), 0.1)


def _verdict(
    p_white: FloatArray, outside: FloatArray, input_names: Sequence[str], output_names: Sequence[str]
) -> tuple[str, ...]:
    words = []
    for j, output in enumerate(output_names):
        white = p_white[j] >= 1 - _LEVEL
        words.append(f"{output}: residuals {'white' if white else 'not white'} (p = {p_white[j]:.2g})")
        left = [name for i, name in enumerate(input_names) if outside[j, i] > 0.1]
        if left:
            words.append(f"{output}: residuals still follow {', '.join(left)}: the structure leaves something out")
    return tuple(words)
