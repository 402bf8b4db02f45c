"""Goal of an excitation: quantities, sensitivities of predictions, design criterion, and expected covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gbid.core.arrays import ComplexArray, FloatArray, one_blas_thread
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive
from gbid.discretise.exact import discretise, propagate
from gbid.excite.model import KnownModel
from gbid.identify.data import FitData, Record
from gbid.identify.options import FitArguments
from gbid.identify.predictor import Predictor, PredictorValues, build_predictor
from gbid.identify.problem.assemble import assemble, build_problem, full_start
from gbid.identify.problem.hessian import in_one_window
from gbid.identify.uncertainty.covariance import Estimate, covariance, mode_slopes

_NOISE_LINES = 2048  # of the integral over the frequencies of the noise's own information


class Lines(NamedTuple):
    """Responses and sensitivities of a model at spectral lines.

    Attributes
    ----------
    frequency_hz : (n_lines,) array
        Frequencies [Hz].
    response : (n_lines, n_outputs, n_inputs) array
        Frequency response from the sampled inputs to the sampled outputs, with their hold.
    sensitivity : (n_lines, n_free, n_outputs, n_inputs) array
        Derivatives of the predictions by the free parameters, by the input; for errors that are white with unit
        covariance.
    """

    frequency_hz: FloatArray
    response: ComplexArray
    sensitivity: ComplexArray

    def information(self, spectrum: ComplexArray, n_samples: int) -> FloatArray:
        """Return the information matrix of a periodic excitation at these lines, (n_free, n_free).

        Parameters
        ----------
        spectrum : (n_lines, n_inputs) array
            Amplitude of each line: the input is ``Re sum U exp(j omega t)``.
        n_samples : int
            Length of the recording.
        """
        columns = np.einsum("fpyu,fu->pfy", self.sensitivity, spectrum).reshape(self.sensitivity.shape[1], -1)
        return np.asarray(n_samples / 2 * (columns @ columns.conj().T).real)


@dataclass(frozen=True, eq=False)
class LineModel(Brief):
    """Predictor of a known model, evaluated at spectral lines.

    Attributes
    ----------
    known : KnownModel
        The model.
    predictor : Predictor
        Its predictor.
    """

    known: KnownModel
    predictor: Predictor

    @classmethod
    def of(cls, known: KnownModel, sample_time: float) -> LineModel:
        """Return the line model of a known model at a sample time [s]."""
        held = {name: float(known.parameters[name]) for name in known.fixed}
        return cls(known, build_predictor(known.structure, held, sample_time, known.intersample, known.focus))

    @property
    def sample_time(self) -> float:
        """Time between samples [s]."""
        return self.predictor.sample_time

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(q.name for q in self.predictor.free)

    @cached_property
    def theta(self) -> FloatArray:
        """Values of the free parameters, (n_free,)."""
        return np.array([float(self.known.parameters[name]) for name in self.free])

    @cached_property
    def _values(self) -> PredictorValues:
        return self.predictor.at(self.theta)

    @cached_property
    def _whiten(self) -> FloatArray:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.known.noise)), float)

    def at(self, frequency_hz: FloatArray) -> Lines:
        """Return responses and sensitivities at frequencies [Hz] below half the sampling frequency."""
        v, z = self._values, self._turns(frequency_hz)
        by_u, by_y = self._regressors(v, z)
        response = _response(v, z, by_u, by_y)
        slopes = _slopes(v, z, by_u if by_y is None else by_u + by_y @ response)
        return Lines(frequency_hz, response, np.einsum("ij,fpju->fpiu", self._whiten, slopes))

    def response(self, frequency_hz: FloatArray, parameters: dict[str, float] | None = None) -> ComplexArray:
        """Response at lines (n_lines, n_outputs, n_inputs); `parameters` replaces some known values."""
        known = {**self.known.parameters, **(parameters or {})}
        v = self.predictor.at(np.array([float(known[name]) for name in self.free])) if parameters else self._values
        z = self._turns(frequency_hz)
        return _response(v, z, *self._regressors(v, z))

    def noise_information(self, n_samples: int) -> FloatArray:
        """Return the information that prediction errors carry on the parameters through the disturbance gain."""
        n_p = len(self.free)
        if not self.predictor.feeds_back:
            return np.zeros((n_p, n_p))
        v = self._values
        z = np.exp(1j * np.pi * (np.arange(_NOISE_LINES) + 0.5) / _NOISE_LINES)
        _, by_y = self._regressors(v, z)
        assert by_y is not None
        # Errors e in, y = yhat + e out.
        through = _transfer(v, z, by_y)
        y = np.linalg.inv(np.eye(through.shape[1]) - through)
        slopes = np.einsum("ij,fpjk,kl->fpil", self._whiten, _slopes(v, z, by_y @ y), np.linalg.inv(self._whiten))
        flat = slopes.transpose(1, 0, 2, 3).reshape(n_p, -1)
        return np.asarray(n_samples / _NOISE_LINES * (flat @ flat.conj().T).real)

    def _turns(self, frequency_hz: FloatArray) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * frequency_hz * self.sample_time))

    def _regressors(self, v: PredictorValues, z: ComplexArray) -> tuple[ComplexArray, ComplexArray | None]:
        """Return the regressors from inputs and from outputs at lines, (n_lines, n_z, n), from impulse responses."""
        n_u, n_y = self.predictor.n_inputs, self.predictor.n_outputs
        middle = max((abs(s) for s in v.shift), default=0) + 4
        none = np.zeros((2 * middle + 1, max(n_u, n_y)))
        turned = z[:, None] ** -(np.arange(2 * middle + 1) - middle)

        def seen(to_input: bool, count: int) -> ComplexArray:
            columns = []
            for i in range(count):
                pulse = none.copy()
                pulse[middle, i] = 1.0
                u, y = (pulse, none) if to_input else (none, pulse)
                columns.append(turned @ self.predictor.regressors(u[:, :n_u], y[:, :n_y], v.shift))
            return np.stack(columns, axis=-1)

        return seen(True, n_u), seen(False, n_y) if self.predictor.feeds_back else None


def _transfer(v: PredictorValues, z: ComplexArray, regressors: ComplexArray) -> ComplexArray:
    """Return the transfer function from a group of regressors to the predictions, (n_lines, n_y, n)."""
    return np.asarray(v.C @ _states(v, z, v.G @ regressors) + v.H @ regressors)


def _states(v: PredictorValues, z: ComplexArray, forcing: ComplexArray) -> ComplexArray:
    eye = np.eye(len(v.F))
    return np.asarray(np.linalg.solve(z[:, None, None] * eye - v.F, forcing))


def _response(v: PredictorValues, z: ComplexArray, by_u: ComplexArray, by_y: ComplexArray | None) -> ComplexArray:
    """Return the response of the outputs; without prediction errors the outputs equal the predictions."""
    direct = _transfer(v, z, by_u)
    if by_y is None:
        return direct
    through = _transfer(v, z, by_y)
    return np.asarray(np.linalg.solve(np.eye(through.shape[1]) - through, direct))


def _slopes(v: PredictorValues, z: ComplexArray, regressors: ComplexArray) -> ComplexArray:
    """Return the derivatives of the predictions by the parameters for fixed data, (n_lines, n_p, n_y, n)."""
    x = _states(v, z, v.G @ regressors)[:, None]
    source = regressors[:, None]
    back = np.linalg.solve((z[:, None, None] * np.eye(len(v.F)) - v.F).transpose(0, 2, 1), v.C.T).transpose(0, 2, 1)
    return np.asarray(back[:, None] @ (v.dF @ x + v.dG @ source) + v.dC @ x + v.dH @ source)


Focused = str | Sequence[str] | Mapping[str, Positive] | None
"""Names or patterns of quantities that count equally (D-optimal), or each with the deviation that counts as one."""

_OTHERS = 0.01
_SINGULAR = 1e-14


@dataclass(frozen=True, eq=False)
class Quantities:
    """Free parameters of a model, and frequency and damping factor of its oscillatory modes.

    Attributes
    ----------
    names : tuple of str
        Free parameters, then ``frequency_1``, ``damping_1``, ``frequency_2`` and so on of the oscillatory modes.
    values : (n,) array
        Their values.
    slopes : (n, n_free) array
        Derivatives by the free parameters.
    """

    names: tuple[str, ...]
    values: FloatArray
    slopes: FloatArray

    def std(self, covariance: FloatArray) -> dict[str, float]:
        """Return standard deviations from the covariance of the free parameters; NaN for undetermined quantities."""
        # A quantity that a parameter does not move is not touched by that parameter's missing deviation.
        unknown = (self.slopes != 0) @ np.isnan(np.diag(covariance))
        variance = np.einsum("qp,pr,qr->q", self.slopes, np.nan_to_num(covariance), self.slopes)
        variance[unknown] = np.nan
        return dict(zip(self.names, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True))

    def matching(self, patterns: Sequence[str], what: str) -> list[int]:
        """Return the indices of the quantities whose names match one of the patterns.

        Raises
        ------
        UsageError
            When a pattern matches none.
        """
        matches = dict[int, None]()
        for pattern in patterns:
            hit = [i for i, name in enumerate(self.names) if fnmatchcase(name, pattern)]
            if not hit:
                raise UsageError(f"{what}: nothing matches {pattern!r}; choose from {', '.join(self.names)}")
            matches |= dict.fromkeys(hit)
        return list(matches)


@dataclass(frozen=True, eq=False)
class DesignGoal:
    """Design criterion for quantities ``J p``: log det (D-optimal) or log trace (A-optimal) of their covariance.

    All parameters together count as well, with a weight of one hundredth. So a design for few quantities leaves no
    parameter undetermined.

    Attributes
    ----------
    names : tuple of str
        Quantities that count.
    J : (n_counted, n_free) array
        Their derivatives; for the A-criterion divided by the deviation that counts as one.
    kind : {"D", "A"}
        Criterion.
    earlier : (n_free, n_free) array or float
        Information without the excitation: from earlier recordings, and from the errors themselves.
    """

    names: tuple[str, ...]
    J: FloatArray
    kind: str
    earlier: FloatArray | float = 0.0

    def loss(self, information: FloatArray) -> float:
        """Return twice the logarithm of a mean standard deviation; infinite if parameters are undetermined."""
        inverse = _inverse(information + self.earlier)
        if inverse is None:
            return np.inf
        n, covariance = len(self.J), self.J @ inverse @ self.J.T
        counted = np.linalg.slogdet(covariance)[1] / n if self.kind == "D" else np.log(np.trace(covariance) / n)
        return float(counted + _OTHERS * np.linalg.slogdet(inverse)[1] / len(inverse))

    def gradient(self, information: FloatArray) -> FloatArray:
        """Return P: an increment dM of the information lowers the loss by tr(P dM).

        Raises
        ------
        UsageError
            When parameters are not determined.
        """
        inverse = _inverse(information + self.earlier)
        if inverse is None:
            raise UsageError(
                "no excitation of these inputs determines all parameters; fix some (KnownModel(..., fixed=...))"
            )
        onto = inverse @ self.J.T
        counted = self.J @ onto
        if self.kind == "D":
            P = onto @ np.linalg.solve(counted, onto.T) / len(counted)
        else:
            P = onto @ onto.T / np.trace(counted)
        return np.asarray(P + _OTHERS / len(inverse) * inverse)


def quantities_of(lines: LineModel) -> Quantities:
    """Return the free parameters and modes of a model, with the derivatives of the modes."""
    A = lines.predictor.matrices(lines.theta)[0]
    modes, slopes = mode_slopes(A)
    of_modes, names, values = list[FloatArray](), list[str](), list[float]()
    met: list[tuple[float, float]] = []
    for (frequency, damping), slope in zip(modes, slopes.transpose(1, 2, 0), strict=True):
        if any(np.allclose((frequency, damping), other, rtol=1e-9) for other in met):
            continue  # the copy of an actuator in a plant with exact delays
        met.append((frequency, damping))
        names += [f"frequency_{len(met)}", f"damping_{len(met)}"]
        values += [frequency, damping]
        of_modes += list(slope)
    n = len(lines.free)
    stacked = np.vstack([np.eye(n), np.reshape(of_modes, (-1, n))])
    return Quantities((*lines.free, *names), np.concatenate([lines.theta, values]), stacked)


def goal_of(lines: LineModel, quantities: Quantities, focus: Focused) -> DesignGoal:
    """Return the design goal for the chosen quantities and criterion.

    Parameters
    ----------
    lines : LineModel
        The model.
    quantities : Quantities
        Its quantities.
    focus : str, sequence of str, dict of str to float, or None
        Names or patterns, such as ``"damping_*"`` or ``("k_*", "tau_*")``: D-criterion of these. A dict gives the
        standard deviation that counts as one: A-criterion, the sum of squares over them. None: D-criterion of all
        parameters that do not belong to the noise model alone.

    Raises
    ------
    UsageError
        When a pattern matches nothing, or a deviation is not positive.
    """
    if isinstance(focus, Mapping):
        picked = dict[int, float]()
        for pattern, unit in focus.items():
            picked |= dict.fromkeys(quantities.matching((pattern,), "focus"), float(unit))
        scale = np.array(list(picked.values()))
        rows = list(picked)
        return DesignGoal(tuple(quantities.names[i] for i in rows), quantities.slopes[rows] / scale[:, None], "A")
    if focus is None:
        rows = [i for i in range(len(lines.free)) if i not in lines.predictor.noise]
    else:
        rows = quantities.matching((focus,) if isinstance(focus, str) else tuple(focus), "focus")
    if not rows:
        raise UsageError("focus names no parameter; give one name or more, or leave focus out")
    slopes = quantities.slopes[rows]
    if len(rows) > 1 and np.linalg.matrix_rank(slopes / np.linalg.norm(slopes, axis=1)[:, None]) < len(rows):
        raise UsageError(
            "focus: these quantities depend on each other, as modes on the parameters that make them; name fewer, or "
            "give the standard deviation that counts as one for each"
        )
    return DesignGoal(tuple(quantities.names[i] for i in rows), slopes, "D")


def _inverse(information: FloatArray) -> FloatArray | None:
    """Return the covariance, the inverse of the information; None for a singular information matrix."""
    size = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    if not values[0] > _SINGULAR * values[-1]:
        return None
    root = vectors / np.sqrt(values) / size[:, None]
    return np.asarray(root @ root.T)


# ---- Expected covariance of a fit to a planned recording, by the equations of the fit.

_SEED = 20260  # of the errors of the simulated recording; the information hardly depends on them


class Expected(NamedTuple):
    """Expected covariance of a fit.

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
    """Return the expected parameter covariance of a fit to a recording with given inputs.

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
    options = FitArguments(intersample=known.intersample, focus=known.focus, criterion="det", window=None)
    with one_blas_thread():
        assembly = assemble(
            known.structure,
            parameters,
            begin,
            data,
            options,
        )
        problem, unknowns = build_problem(assembly, data, options, full_start(assembly, begin))
        problem, kept = in_one_window(problem)
        theta, starts = problem.unpack(unknowns[kept])
        estimate = Estimate(problem, theta, np.zeros_like(starts), assembly.record_window)
        result = covariance(estimate, known.noise * problem.n_samples, np.zeros(len(theta), bool))
    values = result.white.copy()
    values[result.open], values[:, result.open] = np.nan, np.nan
    return Expected(tuple(q.name for q in assembly.free), values)
