"""Start values of a fit whose own start is unstable: those of a fit with a steady observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gbid.discretise import Hold
from gbid.identify.data import FitData
from gbid.identify.kernel.engine import EngineName
from gbid.identify.nlp.solver import solve
from gbid.identify.problem.assembly import assemble, automatic_window, full_start
from gbid.identify.problem.scaling import build_problem, unknown_bounds
from gbid.identify.start.observer import gain_parameters, observer_gain, with_gain
from gbid.structure import Parameter, Structure, evaluate

_REACHES = (0.3, 1.0, 3.0)  # memory of the observers, in time constants: the first one trusts the start values little
_NOISE = 0.1  # assumed standard deviation of the noise, as a part of that of the output
_MOST = 50  # iterations; start values need not be exact


def settled_start(
    structure: Structure,
    parameters: tuple[Parameter, ...],
    begin: Mapping[str, float],
    data: FitData,
    *,
    intersample: Hold | Sequence[Hold],
    left_out: Mapping[str, Sequence[tuple[int, int]]],
    engine: EngineName,
) -> dict[str, float] | None:
    """Return start values from fits with a steady observer in place of the structure's own disturbance gain.

    The observer is a steady Kalman filter for assumed noise. With it the predictor is stable, whatever the start. It
    is computed anew, with a longer memory, at what each fit found. Free parameters of the structure's own
    disturbance gain come near to that of the observer.

    Parameters
    ----------
    structure, parameters, data, intersample, left_out, engine
        As in `gbid.identify.problem.assembly.assemble`.
    begin : dict of str to float
        Start values of all parameters.

    Returns
    -------
    dict of str to float or None
        Start values of all parameters; None when the outputs do not observe an unstable state.
    """
    spread = np.sqrt(np.mean([np.var(record.outputs, axis=0) for record in data.records], axis=0))
    values: dict[str, float] = dict(begin)
    for reach in _REACHES:
        gain = observer_gain(evaluate(structure, values), data.sample_time, _NOISE * spread, reach)
        if gain is None:
            return None
        values = _fitted(
            with_gain(structure, gain), parameters, values, data, 1 / spread**2, intersample, left_out, engine
        )
    gain = observer_gain(evaluate(structure, values), data.sample_time, _NOISE * spread, _REACHES[-1])
    return values if gain is None else {**values, **gain_parameters(structure, parameters, values, gain)}


def _fitted(
    observed: Structure,
    parameters: tuple[Parameter, ...],
    values: Mapping[str, float],
    data: FitData,
    weights: Sequence[float],
    intersample: Hold | Sequence[Hold],
    left_out: Mapping[str, Sequence[tuple[int, int]]],
    engine: EngineName,
) -> dict[str, float]:
    """Return the values of a fit with an observer; those given where it ends nowhere."""
    assembly = assemble(
        observed,
        parameters,
        values,
        data,
        intersample=intersample,
        focus="prediction",
        horizon=1,
        local={},
        left_out=left_out,
        window=automatic_window(data, "prediction"),
        engine=engine,
    )
    problem, unknowns = build_problem(assembly, data, "trace", weights, full_start(assembly, values), {}, True)
    lower, upper = unknown_bounds(problem, assembly)
    solution = solve(problem, np.clip(unknowns, lower, upper), lower, upper, max_iterations=_MOST)
    theta, _ = problem.unpack(solution.unknowns)
    if not np.isfinite(theta).all():
        return dict(values)
    return {**values, **{q.name: float(v) for q, v in zip(assembly.free, theta, strict=True)}}
