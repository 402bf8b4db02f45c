"""Covariance to be expected of a fit to a recording that does not exist yet, by the sums of the fit itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gbid.arrays import FloatArray
from gbid.discretise import discretise, propagate
from gbid.excite.known_model import KnownModel
from gbid.identify.data import FitData, Record
from gbid.identify.nlp.one_window import in_one_window
from gbid.identify.problem.assembly import assemble, full_start
from gbid.identify.problem.scaling import build_problem
from gbid.identify.uncertainty.covariance import covariance
from gbid.threads import one_blas_thread

_SEED = 20260  # of the errors of the simulated recording; the information hardly depends on them


class Expected(NamedTuple):
    """Covariance to be expected.

    Attributes
    ----------
    free : tuple of str
        Free parameters.
    covariance : (n_free, n_free) array
        Their covariance, NaN for those that the recording does not determine.
    """

    free: tuple[str, ...]
    covariance: FloatArray


def simulated_outputs(known: KnownModel, inputs: FloatArray, sample_time: float, errors: FloatArray) -> FloatArray:
    """Return the outputs of a known model for inputs and prediction errors, (n_samples, n_outputs).

    Parameters
    ----------
    known : KnownModel
        The model.
    inputs : (n_samples, n_inputs) array
        Inputs; the recording begins at rest.
    sample_time : float
        Time between samples [s].
    errors : (n_samples, n_outputs) array
        Prediction errors. Through the disturbance gain they move the states, held over a sample as in the predictor.
    """
    model = known.model
    outputs = model.simulate(inputs, sample_time, intersample=known.intersample) + errors
    if model.K is not None and known.focus == "prediction":
        F, gain, _ = discretise(np.array(model.A), np.array(model.K), sample_time, "zoh")
        outputs += propagate(F, errors @ gain.T, np.zeros(len(F))) @ model.C.T
    return np.asarray(outputs)


def expected_covariance(known: KnownModel, inputs: FloatArray, sample_time: float) -> Expected:
    """Return the covariance of the parameters that a fit to a recording with these inputs will have.

    A recording is simulated with the errors of the model. The covariance is that of `gbid.fit` at the true parameters,
    with an estimated initial state and errors that weigh as their covariance says. So it is what the result of a fit
    will contain, apart from the scatter of its estimates.

    Parameters
    ----------
    known : KnownModel
        The model with the noise.
    inputs : (n_samples, n_inputs) array
        Inputs.
    sample_time : float
        Time between samples [s].

    Returns
    -------
    Expected
        Names and covariance of the free parameters, without earlier recordings. NaN where the recording does not
        determine them.
    """
    random = np.random.default_rng(_SEED).standard_normal((len(inputs), len(known.noise)))
    errors = random @ np.linalg.cholesky(known.noise).T
    outputs = simulated_outputs(known, inputs, sample_time, errors)
    labels = known.model.input_names, known.model.output_names
    data = FitData((Record("expected", inputs, outputs),), sample_time, *labels, ("",) * len(labels[1]))
    parameters = tuple(
        q
        if q.name not in known.fixed or q.fixed
        else type(q)(q.name, known.parameters[q.name], fixed=True, unit=q.unit)
        for q in known.structure.parameters
    )
    begin = {name: float(value) for name, value in known.parameters.items()}
    with one_blas_thread():
        assembly = assemble(
            known.structure,
            parameters,
            begin,
            data,
            intersample=known.intersample,
            focus=known.focus,
            horizon=1,
            local={},
            left_out={},
            window=None,
            engine="auto",
        )
        problem, unknowns = build_problem(assembly, data, "det", None, full_start(assembly, begin), {}, True)
        problem, kept = in_one_window(problem)
        theta, starts = problem.unpack(unknowns[kept])
        starts = np.zeros_like(starts)
        found = covariance(
            problem,
            theta,
            starts,
            assembly.record_window,
            known.noise * problem.n_samples,
            np.zeros(len(theta), bool),
        )
    values = found.white.copy()
    dark = np.asarray((np.abs(found.undetermined) > 1e-3).any(axis=0))
    values[dark], values[:, dark] = np.nan, np.nan
    return Expected(tuple(q.name for q in assembly.free), values)
