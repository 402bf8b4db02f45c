"""Plants of a design, their loops as numbers with derivatives by the gains, and the options of `gbid.tune`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import expm, expm_frechet

from gbid.control.controllers.scheduled import Scheduled
from gbid.control.loop.close import Method, sample_plant
from gbid.control.loop.sampled import exact_plant, exact_plant_of
from gbid.control.tuning.goals import Goal, MaxDamping, MaxDecay, SlowestPole
from gbid.control.tuning.loops import (
    PADE_ORDER,
    Derivatives,
    DirectCall,
    LoopEquations,
    LoopFamily,
    Loops,
    controller_matrices,
    loop_delay,
    loop_equations,
)
from gbid.control.tuning.problem import Limits, Objective
from gbid.control.tuning.response_goals import PeakSensitivity
from gbid.core.arrays import ComplexArray, FloatArray, is_real, is_whole, point_label
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.identify import FitResult
from gbid.lpv import ACTUATOR_PARAMETERS, TERMS, Domain, LPVFit, LPVModel, regressors
from gbid.structure import KEY_PARAMETERS, LinearModel, pade_delay, with_pade
from gbid.structure.linear import Structure

Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class ControllerLaw:
    """Matrices of a controller structure at operating points, and their derivatives by the gains.

    Parameters
    ----------
    structure : Structure or Scheduled
        The controller.
    points : (m, 2) array
        Pressure [bar] and speed [rpm] of each loop, for a scheduled controller.
    shape : (n_outputs, n_inputs)
        Number of outputs and of inputs of the controller.
    sample_time : float, optional
        T_s of a sampled controller [s]; None for a continuous one.
    method : {"tustin", "zoh"}
        Method of discretisation.
    """

    structure: Structure | Scheduled
    points: FloatArray
    shape: tuple[int, int]
    sample_time: float | None = None
    method: Method = "tustin"
    _calls: dict[str, DirectCall] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        gains = tuple(self.structure.parameters)
        g, s = ca.SX.sym("gains", len(gains)), ca.SX.sym("point", 2)
        K = controller_matrices(self.structure, gains, g, s, self.shape)
        values = [ca.densify(ca.SX(K[letter])) for letter in "ABCD"]
        slopes = [ca.densify(ca.jacobian(ca.vec(M), g)) for M in values]
        where = self.points.T if isinstance(self.structure, Scheduled) else np.zeros((2, 1))
        m, q = where.shape[1], ca.MX.sym("gains", len(gains))
        for name, outputs in (("values", values), ("slopes", slopes)):
            one = ca.Function(name, [g, s], outputs)
            many = ca.Function(f"{name}_at_points", [q], list(one.map(m)(ca.repmat(q, 1, m), ca.DM(where))))
            self._calls[name] = DirectCall(many, m, self._calls.get("values"))

    def matrices(self, gains: FloatArray) -> Matrices:
        """Return A, B, C, D, each (m, ., .), or (1, ., .) for a controller that is the same in all loops."""
        A, B, C, D = self._calls["values"](gains)
        return (A, B, C, D) if self.sample_time is None else self._sampled(A, B, C, D)

    def derivatives(self, gains: FloatArray) -> tuple[Matrices, Matrices]:
        """Return A, B, C, D and their derivatives, each (m, d, ., .)."""
        values, slopes = self._calls["values"](gains), self._calls["slopes"](gains)
        A, B, C, D = values
        dA, dB, dC, dD = slopes
        if self.sample_time is None:
            return (A, B, C, D), (dA, dB, dC, dD)
        if self.method == "zoh":
            return self._sampled(A, B, C, D), (*self._held_slopes(A, B, dA, dB), dC, dD)
        # Tustin: with M = (I - h A / 2)^-1 the matrices are 2 M - I, h M B, C M, D + h C M B / 2
        h = self.sample_time
        M = np.linalg.inv(np.eye(A.shape[-1]) - h / 2 * A)
        dM = h / 2 * M[:, None] @ dA @ M[:, None]
        MB, CM = M @ B, C @ M
        dMB = dM @ B[:, None] + M[:, None] @ dB
        dCM = dC @ M[:, None] + C[:, None] @ dM
        dDs = dD + h / 2 * (dC @ MB[:, None] + C[:, None] @ dMB)
        return (2 * M - np.eye(A.shape[-1]), h * MB, CM, D + h / 2 * C @ MB), (2 * dM, h * dMB, dCM, dDs)

    def _sampled(self, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> Matrices:
        h = self.sample_time
        assert h is not None
        n = A.shape[-1]
        if self.method == "zoh":
            whole = expm(h * self._with_inputs(A, B))
            return whole[..., :n, :n], whole[..., :n, n:], C, D
        M = np.linalg.inv(np.eye(n) - h / 2 * A)
        return 2 * M - np.eye(n), h * M @ B, C @ M, D + h / 2 * C @ M @ B

    @staticmethod
    def _with_inputs(A: FloatArray, B: FloatArray) -> FloatArray:
        n = A.shape[-1]
        whole = np.zeros((*A.shape[:-2], n + B.shape[-1], n + B.shape[-1]))
        whole[..., :n, :n], whole[..., :n, n:] = A, B
        return whole

    def _held_slopes(
        self, A: FloatArray, B: FloatArray, dA: FloatArray, dB: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        n, h = A.shape[-1], float(self.sample_time or 0.0)
        base, slopes = h * self._with_inputs(A, B), h * self._with_inputs(dA, dB)
        pairs = zip(base, slopes, strict=True)
        found = np.array([[expm_frechet(a, s, compute_expm=False) for s in of] for a, of in pairs])
        return found[..., :n, :n], found[..., :n, n:]


# ---- Uncertainty of the plant: draws from the covariance of an LPV fit.


@dataclass(frozen=True, eq=False)
class Uncertainty(Brief):
    """Uncertainty of the key parameters of a model.

    Parameters
    ----------
    covariance : (84, 84) array, optional
        Covariance of the coefficients of Eq. 16: the fourteen key parameters (`gbid.structure.KEY_PARAMETERS`) with six
        terms each (`gbid.lpv.TERMS`), in SI per bar and rpm, as an LPV fit gives it.
    samples : (n, 14) array, optional
        In place of the covariance: deviations of the key parameters from the model, the same at every operating point.
    draws : int
        Number of plants drawn from the covariance.
    seed : int
        Seed of the draws.
    scatter : (14, 14) array, optional
        Covariance of the deviations of single recordings from the surfaces (`gbid.LPVFit.scatter`). Each draw gets one
        such deviation, the same at every operating point.
    chosen : tuple of int, optional
        Indices of the draws or samples that are used; all by default.

    Raises
    ------
    UsageError
        When not exactly one of the two is given, when its shape is wrong, when the covariance is not symmetric or has a
        negative eigenvalue, or when draws, seed or chosen do not fit.
    """

    covariance: npt.ArrayLike | None = None
    samples: npt.ArrayLike | None = None
    draws: int = 10
    seed: int = 0
    scatter: npt.ArrayLike | None = None
    chosen: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        n = len(KEY_PARAMETERS) * len(TERMS)
        if (self.covariance is None) == (self.samples is None):
            raise UsageError("uncertainty: give either the covariance of the coefficients or samples")
        if self.covariance is not None:
            for name, given, size in (
                ("covariance", self.covariance, n),
                ("scatter", self.scatter, len(KEY_PARAMETERS)),
            ):
                matrix = None if given is None else _array(name, given)
                if matrix is not None and not (matrix.shape == (size, size) and _symmetric(matrix)):
                    raise UsageError(
                        f"uncertainty: {name} has shape {matrix.shape}; give finite and symmetric {(size, size)}"
                    )
            for name, value, least in (("draws", self.draws, 1), ("seed", self.seed, 0)):
                if not is_whole(value, least):
                    raise UsageError(f"uncertainty: {name} = {value!r}; give an integer of at least {least}")
            known = int(self.draws)
        else:
            samples = _array("samples", self.samples)
            known = len(samples) if samples.ndim else 0
            if samples.ndim != 2 or samples.shape[1] != len(KEY_PARAMETERS) or not np.isfinite(samples).all():
                raise UsageError(
                    f"uncertainty: samples have shape {samples.shape}, expected finite (n, {len(KEY_PARAMETERS)})"
                )
        if any(i not in range(known) for i in self.chosen or ()):
            raise UsageError(f"uncertainty: chosen = {self.chosen}; there are {known}, from 0")

    def scenarios(self, points: FloatArray) -> FloatArray:
        """Return every drawn plant at every point, the model itself first: (m (1 + n), 16).

        Parameters
        ----------
        points : (m, 2) array
            Pressure [bar] and speed [rpm].
        """
        deviations = self._deviations(points)
        if self.chosen is not None:
            deviations = [deviations[i] for i in self.chosen]
        nominal = np.hstack([points, np.zeros((len(points), len(KEY_PARAMETERS)))])
        drawn = [np.hstack([points, deviation]) for deviation in deviations]
        return np.vstack([nominal, *drawn])

    def _deviations(self, points: FloatArray) -> list[FloatArray]:
        """Return the deviations (m, 14) of each draw."""
        if self.samples is not None:
            samples = np.asarray(self.samples, float)
            return [np.broadcast_to(sample, (len(points), len(sample))) for sample in samples]
        root = _root(np.asarray(self.covariance, float))
        normal = np.random.default_rng(self.seed).standard_normal((self.draws, len(root)))
        terms = regressors(*points.T)
        coefficients = (normal @ root.T).reshape(self.draws, len(KEY_PARAMETERS), len(TERMS))
        found = [terms @ draw.T for draw in coefficients]
        if self.scatter is not None:
            lift = np.random.default_rng([self.seed, 1]).standard_normal((self.draws, len(KEY_PARAMETERS)))
            lift = lift @ _root(np.asarray(self.scatter, float)).T
            found = [deviation + one for deviation, one in zip(found, lift, strict=True)]
        return found


def _array(name: str, given: npt.ArrayLike | None) -> FloatArray:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise UsageError(f"uncertainty: {name} = {given!r}; give an array of numbers") from None


def _symmetric(matrix: FloatArray) -> bool:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return bool(np.isfinite(matrix).all() and (np.abs(matrix - matrix.T) <= 1e-6 * np.outer(size, size)).all())


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix R with R R' equal to a covariance."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    if values[0] < -1e-6 * max(values[-1], 1.0):
        raise UsageError("uncertainty: the covariance has a negative direction; it is no covariance")
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


# ---- Options of a design.

Point = tuple[float, float]
PlantLike = LPVModel | LPVFit | LinearModel | FitResult
"""What `gbid.tune` takes as a plant."""


@dataclass(frozen=True)
class Sampling:
    """Sampling of a loop on the target.

    Parameters
    ----------
    sample_time : float
        T_s [s].
    computation_s : float
        Time from the sample of p to the change of r [s].
    method : {"tustin", "zoh"}
        Discretisation of the controller.
    """

    sample_time: float
    computation_s: float
    method: Method = "tustin"


@dataclass(frozen=True, eq=False)
class TuneOptions:
    """Options of `gbid.tune`.

    Parameters
    ----------
    goals : sequence of Goal, optional
        Objectives and limits as values from `gbid.control`, such as ``[MaxDamping(), PeakSensitivity(2.0)]``, in place
        of `objective` and `peak_sensitivity`. Without `SlowestPole` among them stability is required only.
    operating_points : sequence of (pressure_bar, speed_rpm), or "domain", optional
        Operating points; by default those of the model. ``"domain"``: the whole rectangle. The worst points are then
        found and added until none is worse by more than 1e-4.
    actuator : dict of str to float, optional
        Parameters of Eq. 12 [rad/s, m/m]; by default those of the model.
    inputs, outputs : sequence of str, optional
        Channels of linear models that the controller drives and measures, in the order of its outputs and inputs.
    peak_sensitivity : float, optional
        Limit M on the peak of the output sensitivity; None maximises damping without this limit, see the notes of
        `gbid.tune`.
    bounds : dict of str to (lower, upper), optional
        Bounds of gains in place of those of the structure.
    uncertainty : Uncertainty, optional
        Drawn plants for which the design must also hold.
    objective : {"damping", "decay"}
        Smallest damping factor of the oscillatory modes, or slowest decay ``-Re`` of all poles [1/s].
    sample_time : float, optional
        Sample time of the target [s]. The design is then that of the sampled controller itself: the plant is
        discretised exactly with held references and its own delays, and the objective is the damping of the sampled
        loop. Continuous designs with Padé delays of order 3 are the starts. Without `sample_time` the loop is
        continuous and has more damping than the sampled one.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    method : {"tustin", "zoh"}
        Discretisation of a sampled controller, see `gbid.control.sample_controller`.
    start : dict of str to float, optional
        Gains as an additional start value.
    starts : int, optional
        Number of starts, as for `gbid.maximise_damping`.
    seed : int
        Seed of the starts.

    Raises
    ------
    UsageError
        When a value is not allowed.
    """

    goals: Sequence[Goal] | None = None
    operating_points: Sequence[Point] | Literal["domain"] | None = None
    actuator: Mapping[str, float] | None = None
    inputs: Sequence[str] | None = None
    outputs: Sequence[str] | None = None
    peak_sensitivity: float | None = 2.6
    bounds: Mapping[str, tuple[float, float]] | None = None
    uncertainty: Uncertainty | None = None
    objective: Objective = "damping"
    sample_time: float | None = None
    computation_s: float | None = None
    method: Method = "tustin"
    start: Mapping[str, float] | None = None
    starts: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.goals is not None and not isinstance(self.goals, Iterable):
            raise UsageError(f"goals = {self.goals!r}; give a list such as [MaxDamping(), PeakSensitivity(2.0)]")
        if self.goals is not None and (self.objective, self.peak_sensitivity) != ("damping", 2.6):
            raise UsageError("tune: objective or peak_sensitivity beside goals; write them as goals, too")
        Limits(self.objective, peak_sensitivity=self.peak_sensitivity)  # raises errors that name the arguments
        loop_delay(self.sample_time, self.computation_s)  # raises the errors of the two
        if self.uncertainty is not None and not isinstance(self.uncertainty, Uncertainty):
            raise UsageError(f"uncertainty is a {type(self.uncertainty).__name__}; give gbid.Uncertainty(covariance)")

    @property
    def delay_s(self) -> float:
        """Delay of the loop by sampling and computation [s]."""
        return loop_delay(self.sample_time, self.computation_s)

    @property
    def sampling(self) -> Sampling | None:
        """Sampling of the target; None for a continuous design."""
        if self.sample_time is None:
            return None
        computation = self.sample_time if self.computation_s is None else self.computation_s
        return Sampling(self.sample_time, computation, self.method)

    def default_goals(self, slowest_mode: float) -> list[Goal]:
        """Return the goals of a design that names none: the objective, and with a peak of S_o the decay of all poles.

        The poles shall decay at least as fast as the slowest mode of the plant does, `slowest_mode` [1/s].
        """
        best = MaxDamping() if self.objective == "damping" else MaxDecay()
        if self.peak_sensitivity is None:
            return [best]
        return [best, SlowestPole(rate=max(slowest_mode, 0.0)), PeakSensitivity(self.peak_sensitivity)]


# ---- Plants of a design: loops at any of their points, and the points with which a search starts.


@dataclass(frozen=True, eq=False)
class Plants(ABC):
    """Plants with one controller structure, whose loops have common gains.

    Parameters
    ----------
    structure : Structure or Scheduled
        Structure of the controller.
    points : (m, 2) array
        Points of the design.
    delay_s : float
        Delay of continuous loops by sampling and computation [s].
    sampling : Sampling, optional
        Rate of the target; None for continuous loops, in which delays are Padé delays.
    """

    structure: Any
    points: FloatArray
    delay_s: float = 0.0
    sampling: Sampling | None = None
    _known: dict[tuple[float, ...], LinearModel] = field(default_factory=dict, init=False, repr=False)

    @property
    def continuous(self) -> Self:
        """The same plants in continuous time."""
        return replace(self, sampling=None)

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Loops at points (m, 2), or some of them."""
        scenarios, labels = self.scenarios(points)
        chosen = list(range(len(scenarios)) if which is None else which)
        rows, names = scenarios[chosen], tuple(labels[i] for i in chosen)
        continuous = self.continuous_family(rows, names)
        if self.sampling is None:
            return continuous
        for row in map(tuple, rows):
            if row not in self._known:
                self._known[row] = self.sampled(row, self.sampling)
        plants = stacked([self._known[row] for row in map(tuple, rows)])
        where, T = np.ascontiguousarray(rows[:, :2]), self.sampling.sample_time
        law = ControllerLaw(self.structure, where, self.plant.D.shape[::-1], T, self.sampling.method)
        return model_family(plants, law, names, continuous.points, continuous)

    @property
    @abstractmethod
    def plant(self) -> LinearModel:
        """One of the plants in continuous time."""

    @property
    @abstractmethod
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay of the oscillatory modes of each open loop [1/s]."""

    @abstractmethod
    def scenarios(self, points: FloatArray) -> tuple[FloatArray, Sequence[str]]:
        """Every plant at every point, as rows that begin with the point, and their names."""

    @abstractmethod
    def continuous_family(self, scenarios: FloatArray, labels: tuple[str, ...]) -> LoopFamily:
        """Continuous loops of scenarios."""

    @abstractmethod
    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Plant of a scenario, sampled with exact delays."""

    @abstractmethod
    def first(self, points: FloatArray) -> list[int]:
        """Return the indices of the loops with which a search over many loops starts."""

    def gain_limits(self, points: FloatArray) -> tuple[tuple[str, FloatArray, float], ...]:
        """Bounds of scheduled gains at the points, as rows over the coefficients in units of their width."""
        if not isinstance(self.structure, Scheduled):
            return ()
        names = [parameter.name for parameter in self.structure.parameters]
        units = np.eye(len(names))
        rows = []
        for P, Omega in dict.fromkeys(map(tuple, points)):
            columns = [self.structure.gains(dict(zip(names, unit, strict=True)), P, Omega) for unit in units]
            for gain in self.structure.base.parameters:
                row = np.array([float(column[gain.name]) for column in columns])
                width = gain.upper - gain.lower
                where = f"{gain.name} at {point_label(P, Omega)}"
                rows.append((f"upper bound of {where}", row / width, gain.upper / width))
                rows.append((f"lower bound of {where}", -row / width, -gain.lower / width))
        return tuple(rows)


def corners(points: FloatArray) -> list[int]:
    """Return the indices of the points nearest to the corners of the rectangle that contains all points."""
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - low) / np.where(high > low, high - low, 1.0)
    places = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]
    return list(dict.fromkeys(int(np.argmin(((unit - corner) ** 2).sum(axis=1))) for corner in places))


# ---- Plants of an LPV model at operating points, with all drawn plants.


@dataclass(frozen=True, eq=False)
class LpvPlants(Plants):
    """Plants of an LPV model at operating points: pressure [bar] and speed [rpm].

    Parameters
    ----------
    equations : LoopEquations
        Symbolic continuous loop of this model and structure.
    lpv : LPVModel
        The model with its actuators.
    uncertainty : Uncertainty, optional
        Draws of the plant for which the design must also hold.
    domain : Domain, optional
        Domain over which the design must hold.
    """

    equations: LoopEquations = field(kw_only=True)
    lpv: LPVModel = field(kw_only=True)
    uncertainty: Uncertainty | None = None
    domain: Domain | None = None

    @classmethod
    def of(cls, lpv: LPVModel, structure: Structure | Scheduled, options: TuneOptions) -> LpvPlants:
        """Plants of a model with the options of a design."""
        lpv, points = _with_actuators(lpv, options.actuator), _points(lpv, options.operating_points)
        return cls(
            structure,
            points,
            options.delay_s,
            options.sampling,
            equations=_equations(lpv, structure, options.delay_s),
            lpv=lpv,
            uncertainty=options.uncertainty,
            domain=lpv.domain if isinstance(options.operating_points, str) else None,
        )

    def with_structure(self, structure: Structure | Scheduled) -> LpvPlants:
        """Return these plants with another controller."""
        return replace(self, structure=structure, equations=_equations(self.lpv, structure, self.delay_s))

    @cached_property
    def plant(self) -> LinearModel:
        """Plant at the first point."""
        return self.lpv.plant_at(float(self.points[0, 0]), float(self.points[0, 1]))

    @property
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay of the oscillatory modes of each open loop [1/s]."""
        return tuple(slowest_mode(self.lpv.at(float(P), float(Omega)).poles()) for P, Omega in self.points)

    def scenarios(self, points: FloatArray) -> tuple[FloatArray, list[str]]:
        """Every plant at every point (m, 2) or (m, 16), and their names."""
        scenarios = points if self.uncertainty is None else self.uncertainty.scenarios(points)
        labels = [
            point_label(P, Omega) + (f", plant {i // len(points)}" if i >= len(points) else "")
            for i, (P, Omega) in enumerate(scenarios[:, :2])
        ]
        return scenarios, labels

    def continuous_family(self, scenarios: FloatArray, labels: tuple[str, ...]) -> LoopFamily:
        """Continuous loops of scenarios."""
        return self.equations.family(scenarios, labels)

    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Plant of a scenario, sampled with exact delays."""
        values = dict(self.lpv.key_parameters(*scenario[:2]))
        for name, change in zip(KEY_PARAMETERS, scenario[2:], strict=False):
            values[name] += change
        negative = [name for name in ("tau_x", "tau_y") if values[name] <= 0]
        if negative:
            raise UsageError(
                f"model {self.lpv.name!r}: a drawn plant has {negative[0]} = {values[negative[0]]:g} s; fix the delays"
            )
        try:
            exact = exact_plant_of({**self.lpv.actuators, **values})
            return sample_plant(exact, sampling.sample_time, sampling.computation_s)
        except UsageError as error:
            raise UsageError(
                f"model {self.lpv.name!r} at {point_label(*scenario[:2])}, or a plant drawn around it, cannot be "
                f"sampled: {error}"
            ) from None

    def first(self, points: FloatArray) -> list[int]:
        """Points nearest to the corners of the operating range."""
        return corners(points)


def _equations(lpv: LPVModel, structure: Structure | Scheduled, delay_s: float) -> LoopEquations:
    delayed = replace(lpv, pade_order=PADE_ORDER) if delay_s else lpv
    return loop_equations(delayed, structure, delay_s=delay_s)


# ---- Plants given as linear models: any plants with named inputs and outputs.

_FIRST = 4


@dataclass(frozen=True, eq=False)
class ModelPlants(Plants):
    """Plants given as models; the first column of a point is the index of its model.

    Parameters
    ----------
    models : tuple of LinearModel
        Continuous plants with equal inputs and outputs; delays may be exact.
    unfinished : tuple of FitResult
        Plants that are fits which did not converge.
    """

    models: tuple[LinearModel, ...] = field(kw_only=True)
    unfinished: tuple[FitResult, ...] = ()

    @property
    def plant(self) -> LinearModel:
        """First of the models."""
        return self.models[0]

    @property
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay of the oscillatory modes of each open loop [1/s]."""
        return tuple(slowest_mode(model.poles()) for model in self.models)

    def scenarios(self, points: FloatArray) -> tuple[FloatArray, list[str]]:
        """Points, and the names of their models."""
        labels = [self.models[int(i)].name for i in points[:, 0]]
        if len(set(labels)) < len(labels):
            labels = [f"{name} ({int(i) + 1})" for name, i in zip(labels, points[:, 0], strict=True)]
        return points, labels

    def continuous_family(self, scenarios: FloatArray, labels: tuple[str, ...]) -> LoopFamily:
        """Continuous loops of the models, with Padé delays."""
        models = [_with_pade_delays(self.models[int(i)], self.delay_s) for i in scenarios[:, 0]]
        law = ControllerLaw(self.structure, scenarios, self.plant.D.shape[::-1])
        return model_family(stacked(models), law, labels, None)

    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Model, sampled with exact delays."""
        return sample_plant(self.models[int(scenario[0])], sampling.sample_time, sampling.computation_s)

    def first(self, points: FloatArray) -> list[int]:
        """Return some models, evenly among all."""
        return sorted({round(i) for i in np.linspace(0, len(points) - 1, _FIRST)})


def _with_pade_delays(model: LinearModel, delay_s: float) -> LinearModel:
    """Return a model with all inputs delayed and its own delays, as Padé delays."""
    smooth = model if model.delay is None else with_pade(model, PADE_ORDER)
    if not delay_s:
        return smooth
    late = pade_delay(delay_s, PADE_ORDER)
    each = np.eye(smooth.D.shape[1])
    a, b, c, d = (np.kron(each, np.array(ca.DM(M))) for M in (late.A, late.B, late.C, late.D))
    A = np.block([[smooth.A, smooth.B @ c], [np.zeros((len(a), len(smooth.A))), a]])
    B, C = np.vstack([smooth.B @ d, b]), np.hstack([smooth.C, smooth.D @ c])
    return replace(smooth, A=A, B=B, C=C, D=smooth.D @ d, K=None, state_names=())


def checked_models(
    models: Sequence[LinearModel],
    structure: Structure | Scheduled,
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
) -> tuple[LinearModel, ...]:
    """Return the models with the chosen channels only, in order.

    Parameters
    ----------
    models : sequence of LinearModel
        Continuous plants.
    structure : Structure
        Structure of the controller.
    inputs, outputs : sequence of str, optional
        Channels of the plant that the controller drives and measures, in the order of its outputs and inputs; by
        default all.

    Raises
    ------
    UsageError
        When a model is sampled or has no such channel, when their number does not fit the controller, or when the
        controller is scheduled.
    """
    if isinstance(structure, Scheduled):
        raise UsageError(f"controller {structure.name!r}: a schedule needs an LPV model, with pressure and speed")
    found = []
    for model in models:
        if model.dt is not None:
            raise UsageError(
                f"model {model.name!r} is sampled at {model.dt:g} s; give the continuous model, and sample_time"
            )
        columns = _places(model, "input", model.input_names, inputs)
        rows = _places(model, "output", model.output_names, outputs)
        for what, n, names in (("outputs", len(columns), structure.outputs), ("inputs", len(rows), structure.inputs)):
            if n != len(names):
                raise UsageError(
                    f"controller {structure.name!r} has {len(names)} {what} ({', '.join(names)}), the plant "
                    f"{model.name!r} {n}; choose channels by inputs= and outputs=, or axes= of the structure"
                )
        found.append(_channels(model, columns, rows))
    return tuple(found)


def _places(model: LinearModel, what: str, names: tuple[str, ...], wanted: Sequence[str] | None) -> list[int]:
    if wanted is not None and len(set(wanted)) < len(wanted):
        raise UsageError(f"{what}s = {wanted!r}: give each {what} once")
    for name in wanted or ():
        if name not in names:
            raise UsageError(f"model {model.name!r} has no {what} {name!r}; there are {', '.join(names)}")
    return list(range(len(names))) if wanted is None else [names.index(name) for name in wanted]


def _channels(model: LinearModel, columns: list[int], rows: list[int]) -> LinearModel:
    delayed = None if model.B_delayed is None else model.B_delayed[:, columns]
    return LinearModel(
        model.A,
        model.B[:, columns],
        model.C[rows],
        model.D[np.ix_(rows, columns)],
        input_names=tuple(model.input_names[i] for i in columns),
        output_names=tuple(model.output_names[i] for i in rows),
        state_names=model.state_names,
        name=model.name,
        B_delayed=delayed,
        delay=None if model.delay is None else model.delay[columns],
    )


# ---- Loops of given plants and one controller, as numbers: continuous, or sampled in the plane of the search.


@dataclass(frozen=True, eq=False)
class PlantMatrices:
    """Matrices of m plants of equal size: A (m, n, n), B (m, n, n_r), C (m, n_p, n), D (m, n_p, n_r)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


@dataclass(frozen=True, eq=False)
class ModelFamily(LoopFamily):
    r"""Loops of plants given by their matrices.

    With ``x' = A x + B r, p = C x + D r``, ``r = K (p + d)`` and :math:`X = (I - D_K D)^{-1}` the reference is
    ``r = X (C_K x_K + D_K C x + D_K d)``. The outputs are ``p + d = S_o d`` and ``r = K S_o d``. The equations of
    sampled loops are the same; their matrices are then those of the bilinear transform, see `search.plane`.

    Parameters
    ----------
    plants : PlantMatrices
        The plants.
    law : ControllerLaw
        The controller.
    """

    plants: PlantMatrices | None = None
    law: ControllerLaw | None = None
    companion: LoopFamily | None = None

    def __post_init__(self) -> None:
        assert self.plants is not None
        assert self.law is not None

    def matrices(self, gains: FloatArray) -> Loops:
        """Return the matrices of all loops."""
        assert self.law is not None
        loops = self._closed(self.law.matrices(gains))
        return loops if self.sample_time is None else _transformed(loops, self.sample_time)[0]

    def derivatives(self, gains: FloatArray) -> Derivatives:
        """Return the matrices with their derivatives."""
        assert self.law is not None
        values, slopes = self.law.derivatives(gains)
        loops, changes = self._closed(values), self._changes(values, slopes)
        if self.sample_time is None:
            return Derivatives(loops.A, loops.B, loops.C, loops.D, *changes)
        turned, P = _transformed(loops, self.sample_time)
        slopes_there = _transformed_slopes(loops, changes, P, self.sample_time)
        return Derivatives(turned.A, turned.B, turned.C, turned.D, *slopes_there)

    def _closed(self, K: Matrices) -> Loops:
        plant, (A_K, B_K, C_K, D_K) = self.plants, K
        assert plant is not None
        m, n_p = len(plant.A), plant.C.shape[1]
        A_K, B_K, C_K, D_K = (np.broadcast_to(M, (m, *M.shape[1:])) for M in (A_K, B_K, C_K, D_K))
        X = _inverse(np.eye(D_K.shape[1]) - D_K @ plant.D)
        r_x, r_k, r_d = X @ D_K @ plant.C, X @ C_K, X @ D_K
        p_x, p_k, p_d = plant.C + plant.D @ r_x, plant.D @ r_k, np.eye(n_p) + plant.D @ r_d
        return Loops(
            np.block([[plant.A + plant.B @ r_x, plant.B @ r_k], [B_K @ p_x, A_K + B_K @ p_k]]),
            np.concatenate([plant.B @ r_d, B_K @ p_d], axis=1),
            np.block([[p_x, p_k], [r_x, r_k]]),
            np.concatenate([p_d, r_d], axis=1),
        )

    def _changes(self, K: Matrices, slopes: Matrices) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the derivatives of the closed loop's A, B, C, D, each (m, d, ., .)."""
        assert self.plants is not None
        G_A, G_B, G_C, G_D = (M[:, None] for M in (self.plants.A, self.plants.B, self.plants.C, self.plants.D))
        _, B_K, C_K, D_K = (M[:, None] for M in K)
        dA_K, dB_K, dC_K, dD_K = slopes
        m, d = len(G_A), dA_K.shape[1]
        X = _inverse(np.eye(D_K.shape[2]) - D_K @ G_D)
        dX = X @ dD_K @ G_D @ X
        dX_C = dX @ C_K + X @ dC_K
        dX_D = dX @ D_K + X @ dD_K
        dr_x, dr_k, dr_d = dX_D @ G_C, dX_C, dX_D
        dr_x, dr_k, dr_d = (np.broadcast_to(M, (m, d, *M.shape[2:])) for M in (dr_x, dr_k, dr_d))
        p_x, p_k = G_C + G_D @ X @ D_K @ G_C, G_D @ X @ C_K
        p_d = np.eye(G_C.shape[2]) + G_D @ X @ D_K
        dA = np.block(
            [
                [G_B @ dr_x, G_B @ dr_k],
                [dB_K @ p_x + B_K @ G_D @ dr_x, dA_K + dB_K @ p_k + B_K @ G_D @ dr_k],
            ]
        )
        dB = np.concatenate([G_B @ dr_d, dB_K @ p_d + B_K @ G_D @ dr_d], axis=2)
        dC = np.block([[G_D @ dr_x, G_D @ dr_k], [dr_x, dr_k]])
        return dA, dB, dC, np.concatenate([G_D @ dr_d, dr_d], axis=2)


def model_family(
    plants: PlantMatrices,
    law: ControllerLaw,
    labels: tuple[str, ...],
    points: FloatArray | None,
    companion: LoopFamily | None = None,
) -> ModelFamily:
    """Return the loops of plants and a controller.

    Parameters
    ----------
    plants : PlantMatrices
        The plants; sampled when the controller is.
    law : ControllerLaw
        The controller.
    labels : tuple of str
        Names of the loops.
    points : (m, 2) array, optional
        Operating points.
    companion : LoopFamily, optional
        The same loops in continuous time, for measures that need it.
    """
    nothing = ca.Function("nothing", [ca.SX.sym("gains", len(tuple(law.structure.parameters)))], [])
    n, T = plants.C.shape[1], law.sample_time
    return ModelFamily(nothing, nothing, labels, points, n, T, plants=plants, law=law, companion=companion)


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return inverses; not finite where there is none: an algebraic loop without solution, a pole at z = -1."""
    try:
        return np.asarray(np.linalg.inv(matrices), np.float64)
    except np.linalg.LinAlgError:
        found = np.full(matrices.shape, np.nan)
        for place in np.ndindex(*matrices.shape[:-2]):
            with suppress(np.linalg.LinAlgError):
                found[place] = np.linalg.inv(matrices[place])
        return found


def _transformed(loops: Loops, T: float) -> tuple[Loops, FloatArray]:
    """Return sampled loops in the plane ``w = (2 / T) (z - 1) / (z + 1)``, and ``(A + I)^-1``."""
    eye, s = np.eye(loops.A.shape[-1]), 2 / np.sqrt(T)
    P = np.asarray(_inverse(loops.A + eye), np.float64)
    CP = loops.C @ P
    return Loops(2 / T * (eye - 2 * P), s * P @ loops.B, s * CP, loops.D - CP @ loops.B), P


def _transformed_slopes(
    loops: Loops, changes: tuple[FloatArray, FloatArray, FloatArray, FloatArray], P: FloatArray, T: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    s, (dA, dB, dC, dD) = 2 / np.sqrt(T), changes
    P1, PB, CP = P[:, None], (P @ loops.B)[:, None], (loops.C @ P)[:, None]
    turned = P1 @ dA
    return (
        4 / T * turned @ P1,
        s * (P1 @ dB - turned @ PB),
        s * (dC @ P1 - CP @ dA @ P1),
        dD - dC @ PB - CP @ dB + CP @ dA @ PB,
    )


def stacked(models: Sequence[LinearModel]) -> PlantMatrices:
    """Return models as stacked matrices of equal size.

    Smaller models get additional states without connection. They decay fast, at different rates, so that the closed
    loop stays diagonalisable.
    """
    n = max(model.n_states for model in models)
    A, B, C = (np.zeros((len(models), *shape)) for shape in ((n, n), (n, models[0].D.shape[1]), (len(models[0].D), n)))
    fastest = max(float(np.abs(model.poles()).max()) if model.n_states else 1.0 for model in models)
    for i, model in enumerate(models):
        k = model.n_states
        A[i, :k, :k], B[i, :k], C[i, :, :k] = model.A, model.B, model.C
        spare = 1 + 0.1 * np.arange(n - k)
        A[i, k:, k:] = np.diag(0.02 * spare if model.dt is not None else -fastest * spare)
    return PlantMatrices(A, B, C, np.array([model.D for model in models]))


# ---- Plants of a design from what a user gives: an LPV model, linear models, fits, or a list of these.


def plants_of(
    model: PlantLike | Sequence[PlantLike], structure: Structure | Scheduled, options: TuneOptions
) -> LpvPlants | ModelPlants:
    """Plants of a design.

    Raises
    ------
    UsageError
        When a model is of another kind, or when options do not belong to it.
    """
    if isinstance(model, LPVFit):
        model = model.model
    if isinstance(model, LPVModel):
        if (options.inputs, options.outputs) != (None, None):
            raise UsageError("tune: inputs and outputs choose channels of linear models; an LPV model has r and p")
        return LpvPlants.of(model, structure, options)
    given = list(model) if isinstance(model, Sequence) else [model]
    if not given:
        raise UsageError("tune: no models")
    if options.uncertainty is not None:
        raise UsageError("tune: uncertainty belongs to an LPV model; give the drawn models in the list")
    models = [one for each in given for one in _linear(each, options)]
    for name in ("operating_points", "actuator"):
        if getattr(options, name) is not None and not any(isinstance(each, LPVModel | LPVFit) for each in given):
            raise UsageError(f"tune: {name} belongs to LPV models; leave it out")
    chosen = checked_models(models, structure, options.inputs, options.outputs)
    points = np.column_stack([np.arange(len(chosen), dtype=float), np.zeros(len(chosen))])
    unfinished = tuple(each for each in given if isinstance(each, FitResult) and not each.success)
    return ModelPlants(structure, points, options.delay_s, options.sampling, models=chosen, unfinished=unfinished)


def _with_actuators(lpv: LPVModel, actuator: Mapping[str, float] | None) -> LPVModel:
    given = lpv.actuators if actuator is None else actuator
    missing = [name for name in ACTUATOR_PARAMETERS if name not in given]
    if missing:
        raise UsageError(f"model {lpv.name!r} has no actuator {', '.join(missing)}; give actuator={{...}}")
    return lpv if actuator is None else replace(lpv, actuators=dict(actuator))


def _linear(given: PlantLike, options: TuneOptions) -> list[LinearModel]:
    """Linear models of one entry of a list: one for each operating point of an LPV model."""
    if isinstance(given, LPVFit):
        given = given.model
    if isinstance(given, LPVModel):
        machine = _with_actuators(given, options.actuator)
        places = [(float(P), float(Omega)) for P, Omega in _points(machine, options.operating_points)]
        return [
            machine.plant_at(*place) if options.sampling is None else exact_plant(machine, *place) for place in places
        ]
    model = given.model if isinstance(given, FitResult) else given
    if not isinstance(model, LinearModel):
        raise UsageError(
            f"tune: a {type(given).__name__} is no plant; give an LPV model, a LinearModel (of a nonlinear one its "
            "linearise(x0, u0)), a fit, or a list of these"
        )
    return [model]


def _points(lpv: LPVModel, given: Sequence[Point] | str | None) -> FloatArray:
    """Return operating points (m, 2), checked against the domain; of a whole domain its corners and middles."""
    if isinstance(given, str):
        if given != "domain":
            raise UsageError(f"operating_points = {given!r}; give a list of (pressure_bar, speed_rpm) or 'domain'")
        (p0, p1), (w0, w1) = lpv.domain.pressure_bar, lpv.domain.speed_rpm
        return np.array([(p, w) for p in (p0, (p0 + p1) / 2, p1) for w in (w0, (w0 + w1) / 2, w1)])
    points = lpv.operating_points if given is None else given
    try:
        array = np.array([(float(P), float(Omega)) for P, Omega in points])
    except (TypeError, ValueError):
        raise UsageError("operating_points: give a list of (pressure_bar, speed_rpm)") from None
    if not len(array):
        raise UsageError(
            f"model {lpv.name!r} lists no operating points; give operating_points=[(pressure, speed), ...]"
        )
    lpv.domain.check(tuple(array.T), f"model {lpv.name!r}")
    return array


def slowest_mode(poles: ComplexArray) -> float:
    """Return the slowest decay [1/s] of the oscillatory modes, negative when one is unstable."""
    pairs = poles[~is_real(poles)]
    return float(-pairs.real.max()) if len(pairs) else 0.0
