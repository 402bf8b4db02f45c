"""A shooting problem with one unknown gain, whose sums can be written down."""

import numpy as np
from fit_cases import H, levels

from gbid.identify.data import gather
from gbid.identify.options import FitArguments
from gbid.identify.problem.assemble import assemble, build_problem
from gbid.recording import Recording
from gbid.structure import LinearStructure, Parameter, evaluate

DECAY = 1.5
GAIN = LinearStructure(
    "lag of unknown gain", [Parameter("b", 2.0)], lambda p: {"A": [[-DECAY]], "B": [[p.b]], "C": [[1]]}
)


def small_problem(n=400, records=1):
    """Problem, unknowns, first windows; for each record slopes of the output by gain and initial state, and errors."""
    recordings, slopes, errors = [], [], []
    for i in range(records):
        u = levels(n, seed=i)
        unit = evaluate(GAIN, {"b": 1.0})
        by_gain = unit.simulate(u, H)[:, 0]
        by_start = unit.simulate(0 * u, H, initial_state=[1.0])[:, 0]
        y = 2.2 * by_gain + 0.1 * np.random.default_rng(i).normal(size=n)
        recordings.append(Recording({"u": u, "y": y[:, None]}, H, name=f"{i}"))
        slopes.append(np.column_stack([by_gain, by_start]))
        errors.append(y - 2.0 * by_gain)
    data = gather(recordings, ("u",), ("y",), minimum=10)
    options = FitArguments(focus="simulation", window=None)
    assembly = assemble(GAIN, GAIN.parameters, {"b": 2.0}, data, options)
    problem, _ = build_problem(assembly, data, options, {"b": 2.0})
    unknowns = problem.pack(np.array([2.0]), np.zeros((problem.n_windows, 1)))
    return problem, unknowns, assembly.record_window, slopes, errors
