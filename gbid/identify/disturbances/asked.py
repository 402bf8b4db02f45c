"""Disturbances that the options of a fit ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from gbid.errors import UsageError
from gbid.identify.disturbances.disturbances import Disturbances, Trend

TrendName = Literal["none", "offset", "linear", "random walk"] | int
"""Trend of an output: a word, or the degree of a polynomial."""
TREND_WORDS = {"none": Trend(0), "offset": Trend(1), "linear": Trend(2), "random walk": Trend(0, random_walk=True)}
HIGHEST_DEGREE = 9


def asked_disturbances(
    trend: TrendName | Mapping[str, TrendName],
    hum: float | Sequence[float],
    offsets: bool,
    outputs: tuple[str, ...],
    sample_time: float,
    focus: str,
) -> Disturbances:
    """Return the disturbances for the options `trend`, `hum` and `offsets` of `gbid.fit`.

    Parameters
    ----------
    trend : str, int or dict
        Trend of all outputs, or of each output channel by name.
    hum : float or sequence of float
        Frequencies [Hz].
    offsets : bool
        Whether offsets are estimated: the same as the trend ``"offset"``.
    outputs : tuple of str
        Names of the output channels.
    sample_time : float
        Time between samples [s]; 0 when it is not known yet.
    focus : {"prediction", "simulation"}
        Focus of the fit.

    Returns
    -------
    Disturbances
        The disturbances.

    Raises
    ------
    UsageError
        When an option is unknown or does not fit the data.
    """
    if offsets and trend != "none":
        raise UsageError(f"offsets = True with trend = {trend!r}; offsets mean trend = 'offset': give trend alone")
    chosen = "offset" if offsets else trend
    if isinstance(chosen, Mapping):
        unknown = [name for name in chosen if name not in outputs]
        if unknown:
            raise UsageError(
                f"trend names {unknown[0]!r}, which is no output of the fit; they are {', '.join(outputs)}"
            )
        trends = tuple(_trend(chosen.get(name, "none")) for name in outputs)
    else:
        trends = (_trend(chosen),) * len(outputs)
    if focus == "simulation" and any(each.random_walk for each in trends):
        raise UsageError("trend = 'random walk' is for focus = 'prediction'; give a degree for a simulation")
    frequencies = (hum,) if isinstance(hum, int | float) else tuple(hum)
    highest = 1 / (2 * sample_time) if sample_time else math.inf
    for frequency in frequencies:
        if not (math.isfinite(frequency) and 0 < frequency < highest):
            raise UsageError(f"hum = {frequency} Hz; give frequencies above 0 and below {highest:g} Hz")
    if len({f"{frequency:.10g}" for frequency in frequencies}) < len(frequencies):
        raise UsageError(f"hum = {list(frequencies)}: a frequency is given twice; give each once")
    return Disturbances(outputs, trends, tuple(float(f) for f in frequencies))


def _trend(name: TrendName) -> Trend:
    if isinstance(name, str) and name in TREND_WORDS:
        return TREND_WORDS[name]
    if isinstance(name, int) and not isinstance(name, bool) and 0 <= name <= HIGHEST_DEGREE:
        return Trend(name + 1)
    words = ", ".join(map(repr, TREND_WORDS))
    raise UsageError(f"trend = {name!r}; choose {words}, or a degree from 0 to {HIGHEST_DEGREE}")
