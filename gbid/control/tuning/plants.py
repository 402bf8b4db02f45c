"""Plants of a design, their loops as numbers with derivatives by the gains, and the options of `gbid.tune`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import product
from typing import Annotated, Any, Literal, Self

import casadi as ca
import numpy as np
import numpy.typing as npt

from gbid.control.controllers.structures import Scheduled
from gbid.control.loop.close import force_entry, sample_plant
from gbid.control.loop.sampled import exact_plant, exact_plant_of
from gbid.control.tuning.design_options import DesignOptions, Sampling
from gbid.control.tuning.goals import Goal, MaxDamping, MaxDecay, SlowestPole
from gbid.control.tuning.loops import (
    PADE_ORDER,
    ControllerLaw,
    ControlLoops,
    LoopFamily,
    PlantMatrices,
    WholePlants,
)
from gbid.control.tuning.problem import Evaluations, GainProblem, Limits
from gbid.control.tuning.reach import with_unmoved
from gbid.control.tuning.response_goals import PeakSensitivity
from gbid.control.tuning.search import typical_rate
from gbid.core.arrays import ComplexArray, FloatArray, Point, is_real
from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Allowed, Count, CountOrZero, NotNegative, Positive, check_options
from gbid.identify import FitResult
from gbid.lpv import Domain, LPVFit, LPVModel
from gbid.lpv.model import ACTUATOR_PARAMETERS, EXPONENTS, TERMS, regressors
from gbid.structure import KEY_PARAMETERS, LinearModel, RotorBearing
from gbid.structure.delay import pade_matrices, with_pade
from gbid.structure.linear import Structure, symbolic_matrices
from gbid.structure.scheduling import SCHEDULING, Exponents

# ---- Uncertainty of the plant: draws from the covariance of an LPV fit.


@dataclass(frozen=True, eq=False)
class Uncertainty(Brief):
    """Uncertainty of the key parameters of a model.

    Parameters
    ----------
    covariance : (84, 84) array, optional
        Covariance of the coefficients of Eq. 16: the fourteen key parameters (`gbid.structure.KEY_PARAMETERS`) with six
        terms each (`TERMS`), in SI per bar and rpm, as an LPV fit gives it. (14 m, 14 m) for a model with m terms over
        other scheduling variables.
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
    draws: Count = 10
    seed: CountOrZero = 0
    scatter: npt.ArrayLike | None = None
    chosen: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_options(self, "Uncertainty")
        if (self.covariance is None) == (self.samples is None):
            raise UsageError("uncertainty: give either the covariance of the coefficients or samples")
        if self.covariance is not None:
            k = len(KEY_PARAMETERS)
            n = len(np.atleast_1d(_array("covariance", self.covariance)))
            n = n if n and n % k == 0 else k * len(TERMS)
            for name, given, size in (("covariance", self.covariance, n), ("scatter", self.scatter, k)):
                matrix = np.zeros((size, size)) if given is None else _array(name, given)
                if matrix.shape != (size, size) or not _symmetric(matrix):
                    raise UsageError(
                        f"uncertainty: {name} has shape {matrix.shape}; give finite and symmetric {(size, size)}"
                    )
            known = int(self.draws)
        else:
            samples = _array("samples", self.samples)
            known = len(samples) if samples.ndim else 0
            if samples.ndim != 2 or samples.shape[1] != len(KEY_PARAMETERS) or not np.isfinite(samples).all():
                raise UsageError(
                    f"uncertainty: samples have shape {samples.shape}, expected finite (n, {len(KEY_PARAMETERS)})"
                )
        if any(i not in range(known) for i in self.chosen or ()):
            raise UsageError(f"uncertainty: chosen = {self.chosen}; choose from the {known} draws, numbered from 0")

    def scenarios(self, points: FloatArray, exponents: Exponents = EXPONENTS) -> FloatArray:
        """Return every drawn plant at every point, the model itself first: (m (1 + n), n_variables + 14).

        Parameters
        ----------
        points : (m, n_variables) array
            Scheduling variables, such as pressure [bar] and speed [rpm].
        exponents : tuple of tuple of int
            Powers of the variables in each term of the model.

        Raises
        ------
        UsageError
            When the covariance is that of another number of terms.
        """
        deviations = self._deviations(points, exponents)
        if self.chosen is not None:
            deviations = [deviations[i] for i in self.chosen]
        nominal = np.hstack([points, np.zeros((len(points), len(KEY_PARAMETERS)))])
        drawn = [np.hstack([points, deviation]) for deviation in deviations]
        return np.vstack([nominal, *drawn])

    def _deviations(self, points: FloatArray, exponents: Exponents) -> list[FloatArray]:
        """Return the deviations of the parameters of each draw (m, 14)."""
        if self.samples is not None:
            samples = np.asarray(self.samples, float)
            return [np.broadcast_to(sample, (len(points), len(sample))) for sample in samples]
        root = root_of(np.asarray(self.covariance, float))
        if len(root) != len(KEY_PARAMETERS) * len(exponents):
            text = f"uncertainty: covariance of {len(root)} coefficients, a model with {len(exponents)} terms"
            raise UsageError(f"{text}; give that of its fit")
        normal = np.random.default_rng(self.seed).standard_normal((self.draws, len(root)))
        terms = regressors(*points.T, exponents=exponents)
        coefficients = (normal @ root.T).reshape(self.draws, len(KEY_PARAMETERS), len(exponents))
        draws = [terms @ draw.T for draw in coefficients]
        if self.scatter is not None:
            lift = np.random.default_rng([self.seed, 1]).standard_normal((self.draws, len(KEY_PARAMETERS)))
            lift = lift @ root_of(np.asarray(self.scatter, float)).T
            draws = [deviation + one for deviation, one in zip(draws, lift, strict=True)]
        return draws


def _array(name: str, given: npt.ArrayLike | None) -> FloatArray:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise UsageError(f"uncertainty: {name} = {given!r}; give an array of numbers") from None


def _symmetric(matrix: FloatArray) -> bool:
    size = np.sqrt(np.abs(np.diag(matrix)))
    return bool(np.isfinite(matrix).all() and (np.abs(matrix - matrix.T) <= 1e-6 * np.outer(size, size)).all())


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a matrix R with R R' equal to a covariance."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    if values[0] < -1e-6 * max(values[-1], 1.0):
        raise UsageError("uncertainty: the covariance has a negative eigenvalue; give a positive semidefinite one")
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


# ---- Options of a design.

PlantLike = LPVModel | LPVFit | LinearModel | FitResult
PlantsLike = PlantLike | Sequence[PlantLike] | Mapping[str, PlantLike]
"""What `gbid.tune` takes as a plant."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TuneOptions(DesignOptions):
    """Options of `gbid.tune`.

    Parameters
    ----------
    goals : sequence of Goal, optional
        Objectives and limits as values from `gbid.control`, such as ``[MaxDamping(), PeakSensitivity(2.0)]``, in place
        of `objective` and `peak_sensitivity`. Without `SlowestPole` among them stability is required only.
    operating_points : sequence of (pressure_bar, speed_rpm), or "domain", optional
        Operating points, or values of other scheduling variables; by default those of the model. ``"domain"``: the
        whole rectangle. The worst points are then
        found and added until none is worse by more than 1e-4.
    actuator : dict of str to float, optional
        Parameters of Eq. 12 [rad/s, m/m]; by default those of the model.
    inputs, outputs : sequence of str, optional
        Channels of linear models that the controller drives and measures, in the order of its outputs and inputs.
    speeds_rpm : sequence of float, optional
        Speed of each linear model of a list, for structures that follow it, gains scheduled over it
        (``scheduled(..., ("1", "Omega"), Domain((0, 0), (low, high)))``) and goals at multiples of it.
    peak_sensitivity : float, optional
        Limit M on the peak of the output sensitivity; None maximises damping without this limit, see the notes of
        `gbid.tune`.
    bounds : dict of str to (lower, upper), optional
        Bounds of gains in place of those of the structure. Wider ones of the constant coefficient of a scheduled gain
        hold for the gain at every point, too.
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
    seeds : int
        Number of independent searches, with the seeds from `seed` on; the result is the best of them. They end early
        when three have found the same design, and when the budget is used up. Up to three gains need one search only.
    evaluations : int, optional
        Budget of all searches: number of designs after which they end, about.
    seconds : float, optional
        Budget of searches and checks: time of the clock after which they end, but for an evaluation or two. Searches
        have four fifths of it; `verified_on` says what was not checked. With a budget that ends a search, the status
        is ``"iteration limit"`` unless the design so far has a certificate.

    Raises
    ------
    UsageError
        When a value is not allowed.
    """

    goals: Annotated[Sequence[Goal], Allowed("a list such as [MaxDamping(), PeakSensitivity(2.0)]")] | None = None
    operating_points: Sequence[Point] | Literal["domain"] | None = None
    actuator: Mapping[str, float] | None = None
    inputs: Sequence[str] | None = None
    outputs: Sequence[str] | None = None
    speeds_rpm: Sequence[float] | None = None
    uncertainty: Annotated[Uncertainty, Allowed("gbid.Uncertainty(covariance)")] | None = None
    sample_time: Annotated[Positive, Allowed("seconds, above 0")] | None = None
    computation_s: Annotated[NotNegative, Allowed("seconds, 0 or more")] | None = None

    def __post_init__(self) -> None:
        check_options(self)
        if self.goals is not None and (self.objective, self.peak_sensitivity) != ("damping", 2.6):
            raise UsageError("tune: objective or peak_sensitivity beside goals; write them as goals, too")
        if self.computation_s is not None and self.sample_time is None:
            raise UsageError("computation_s: give sample_time as well")

    @property
    def delay_s(self) -> float:
        """Delay of the loop by holding the references (half a sample) and by their computation [s]."""
        sampling = self.sampling
        return 0.0 if sampling is None else sampling.computation_s + sampling.sample_time / 2

    @property
    def sampling(self) -> Sampling | None:
        """Sampling of the target; None for a continuous design."""
        if self.sample_time is None:
            return None
        computation = self.sample_time if self.computation_s is None else self.computation_s
        return Sampling(self.sample_time, computation, self.method)

    def default_goals(self, slowest_mode: float) -> list[Goal]:
        """Return the default goals: the objective and, with a limit on the peak of S_o, the decay of all poles.

        The poles shall decay at least as fast as the slowest mode of the plant does, `slowest_mode` [1/s].
        """
        best = MaxDamping() if self.objective == "damping" else MaxDecay()
        if self.peak_sensitivity is None:
            return [best]
        return [best, SlowestPole(rate=max(slowest_mode, 0.0)), PeakSensitivity(self.peak_sensitivity)]


# ---- Plants of a design: loops at all operating points, and the points with which a search starts.


FEW_LOOPS = 5
"""Largest number of loops that are designed for at once, with many gains."""


@dataclass(frozen=True, eq=False)
class Plants(ABC):
    """Plants of a design with one controller structure and common gains.

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
    box : tuple, optional
        Bounds of the gains, limits and typical rate, with which modes that no gain moves leave the loops; see
        `with_unmoved`. None: there are none at the points.
    unmoved : tuple of complex
        Rates of these modes at the points [rad/s].
    """

    structure: Any
    points: FloatArray
    delay_s: float = 0.0
    sampling: Sampling | None = None
    box: tuple[FloatArray, FloatArray, Limits, float] | None = None
    unmoved: tuple[complex, ...] = ()
    _known: dict[tuple[float, ...], LinearModel] = field(default_factory=dict, init=False, repr=False)

    @property
    def continuous(self) -> Self:
        """These plants in continuous time."""
        return replace(self, sampling=None)

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Loops at all or chosen points (m, n_variables), without the modes that no gain moves."""
        family = self._loops(points, which)
        return family if self.box is None else with_unmoved(family, *self.box)

    def within(self, lower: FloatArray, upper: FloatArray, limits: Limits, middle: FloatArray) -> Self:
        """Return these plants without the modes that no gain within bounds moves."""
        family = self._loops(self.points)
        scale = typical_rate((family,), middle)
        found = with_unmoved(family, lower, upper, limits, scale).unmoved
        if found is None:
            return self
        return replace(self, box=(lower, upper, limits, scale), unmoved=tuple(rate for _, rate in found.modes))

    def _loops(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        scenarios, labels = self.scenarios(points)
        chosen = list(range(len(scenarios)) if which is None else which)
        rows, names = scenarios[chosen], tuple(labels[i] for i in chosen)
        where, n_p = np.ascontiguousarray(rows[:, : self.n_variables]), self.plant.D.shape[0]
        plants, whole = self.continuous_plants(rows), partial(self.whole_plants, rows)
        continuous = ControlLoops(names, where, n_p, plants=plants, law=self._law, whole=whole)
        if self.sampling is None:
            return continuous
        for row in map(tuple, rows):
            if row not in self._known:
                self._known[row] = self.sampled(row, self.sampling)
        T = self.sampling.sample_time
        plants = PlantMatrices.stacked([self._known[row] for row in map(tuple, rows)]).in_plane(T)
        law = replace(self._law, held_s=T if self.sampling.method == "zoh" else None)
        return ControlLoops(names, where, n_p, T, plants=plants, law=law, companion=continuous)

    def problem(
        self,
        limits: Limits,
        lower: FloatArray,
        upper: FloatArray,
        middle: FloatArray,
        budget: Evaluations,
        few: bool = False,
    ) -> GainProblem:
        """Design problem of the loops at the points; with `few`, of the loops with which a search starts."""
        families = (self.family(self.points),)
        scale, linear = typical_rate(families, middle), self.gain_limits(self.points, lower, upper)
        if few and len(families[0]) > FEW_LOOPS:
            families = (self.family(self.points, self.first(self.points)),)
        return GainProblem(families, limits, lower, upper, scale, linear, evaluations=budget)

    @cached_property
    def _law(self) -> ControllerLaw:
        return ControllerLaw.of(self.structure, self.plant.D.shape[::-1])

    @property
    def n_variables(self) -> int:
        """Number of scheduling variables, with which a scenario begins."""
        return len(self.structure.domain.variables) if isinstance(self.structure, Scheduled) else 2

    @property
    @abstractmethod
    def plant(self) -> LinearModel:
        """Plant in continuous time that represents all plants: the plant at the first point, or the first model."""

    @property
    @abstractmethod
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay rate [1/s] of each plant, over the oscillatory modes that feedback can move."""

    @abstractmethod
    def scenarios(self, points: FloatArray) -> tuple[FloatArray, Sequence[str]]:
        """Every plant at every point as rows that begin with the point, and the names of the rows."""

    @abstractmethod
    def continuous_plants(self, scenarios: FloatArray) -> PlantMatrices:
        """Continuous plants of scenarios, with Padé delays."""

    @abstractmethod
    def whole_plants(self, scenarios: FloatArray) -> WholePlants:
        """Continuous plants with all their channels; plants of an LPV model also with forces on the rotor as inputs."""

    @abstractmethod
    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Plant of a scenario, sampled with exact delays."""

    @abstractmethod
    def first(self, points: FloatArray) -> list[int]:
        """Return the indices of the loops with which a search over many loops starts."""

    def gain_limits(
        self, points: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[tuple[str, FloatArray, float], ...]:
        """Bounds of scheduled gains at the points, as rows over the coefficients in units of their range.

        The bounds are taken from the structure, or from the constant coefficient where its bounds are wider.
        """
        if not isinstance(self.structure, Scheduled):
            return ()
        names = [parameter.name for parameter in self.structure.parameters]
        units = np.eye(len(names))
        rows = []
        for point in dict.fromkeys(map(tuple, points[:, : self.n_variables])):
            columns = [self.structure.gains(dict(zip(names, unit, strict=True)), *point) for unit in units]
            for gain in self.structure.base.parameters:
                row, i = np.array([float(column[gain.name]) for column in columns]), names.index(f"{gain.name}_1")
                low, high = min(gain.lower, lower[i]), max(gain.upper, upper[i])
                where = f"{gain.name} at {self.structure.domain.label(*point)}"
                rows.append((f"upper bound of {where}", row / (high - low), high / (high - low)))
                rows.append((f"lower bound of {where}", -row / (high - low), -low / (high - low)))
        return tuple(rows)


@dataclass(frozen=True, eq=False)
class LpvPlants(Plants):
    """Plants of an LPV model at operating points.

    Parameters
    ----------
    lpv : LPVModel
        The model with its actuators.
    others : tuple of LPVModel
        Models with the same actuators for which the design must also hold.
    uncertainty : Uncertainty, optional
        Draws of the plant for which the design must also hold.
    domain : Domain, optional
        Domain over which the design must hold.
    """

    lpv: LPVModel = field(kw_only=True)
    others: tuple[LPVModel, ...] = ()
    uncertainty: Uncertainty | None = None
    domain: Domain | None = None

    @classmethod
    def of(
        cls, lpv: LPVModel, structure: Structure | Scheduled, options: TuneOptions, others: tuple[LPVModel, ...] = ()
    ) -> LpvPlants:
        """Return the plants of an LPV model for the options of a design."""
        lpv, points = _with_actuators(lpv, options.actuator), _points(lpv, options.operating_points)
        if isinstance(structure, Scheduled) and structure.domain.variables != lpv.scheduling:
            raise UsageError(
                f"controller {structure.name!r} is scheduled over {', '.join(structure.domain.variables)}, model "
                f"{lpv.name!r} over {', '.join(lpv.scheduling)}; give scheduled(..., domain=model.domain)"
            )
        if options.uncertainty is not None and tuple(lpv.coefficients) != KEY_PARAMETERS:
            text = f"uncertainty: the surfaces of model {lpv.name!r} are {', '.join(lpv.coefficients)}"
            raise UsageError(f"{text}, not the key parameters of a gas bearing; leave uncertainty out")
        return cls(
            structure,
            points,
            options.delay_s,
            options.sampling,
            lpv=lpv,
            others=others,
            uncertainty=options.uncertainty,
            domain=lpv.domain if isinstance(options.operating_points, str) else None,
        )

    @property
    def n_variables(self) -> int:
        """Number of scheduling variables, with which a scenario begins."""
        return len(self.lpv.scheduling)

    @cached_property
    def plant(self) -> LinearModel:
        """Plant at the first point."""
        return self.lpv.plant_at(*self.points[0].tolist())

    @cached_property
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay rate [1/s] of each plant, over the oscillatory modes that feedback can move."""
        every = (self.lpv, *self.others)
        return tuple(
            min(slowest_mode(lpv.at(*point).poles(), self.unmoved) for lpv in every) for point in self.points.tolist()
        )

    def scenarios(self, points: FloatArray) -> tuple[FloatArray, list[str]]:
        """Every plant at every point, with or without changes of the surfaces, and the names of the plants."""
        uncertainty, k = self.uncertainty, self.n_variables
        scenarios = points if uncertainty is None else uncertainty.scenarios(points, self.lpv.exponents)
        if self.others and points.shape[1] == k:
            known, *further = (lpv.key_parameters(*points.T) for lpv in (self.lpv, *self.others))
            changes = [
                np.column_stack([key[name] - known[name] for name in self.lpv.coefficients])
                for key in (known, *further)
            ]
            scenarios = np.vstack([np.hstack([points, change]) for change in changes])
        labels = [
            self.lpv.domain.label(*point) + (f", plant {i // len(points)}" if i >= len(points) else "")
            for i, point in enumerate(scenarios[:, :k])
        ]
        return scenarios, labels

    @cached_property
    def _function(self) -> ca.Function:
        """Function from scheduling variables and deviations of the surfaces to A, B, C and D of the plant."""
        lpv, k = self.lpv, self.n_variables
        s = ca.SX.sym("scenario", k + len(lpv.coefficients))
        values = {**lpv.actuators, **lpv.key_parameters(*ca.vertsplit(s[:k]))}
        values |= {name: values[name] + s[k + i] for i, name in enumerate(lpv.coefficients)}
        structure = lpv.plant_structure(PADE_ORDER if self.delay_s else lpv.pade_order)
        p, symbolic = symbolic_matrices(structure)
        plant = pade_matrices(symbolic, PADE_ORDER)
        given = ca.vertcat(*(values[parameter.name] for parameter in structure.parameters))
        matrices = ca.Function("matrices", [p], [ca.densify(M) for M in (plant.A, plant.B, plant.C, plant.D)])
        return ca.Function("plant", [s], matrices.call([given]))

    def continuous_plants(self, scenarios: FloatArray) -> PlantMatrices:
        """Continuous plants of scenarios, with Padé delays."""
        m = len(scenarios)
        S = np.zeros((m, self._function.size1_in(0)))
        S[:, : scenarios.shape[1]] = scenarios
        every: Any = self._function.map(m)(ca.DM(S.T))
        parts = (np.array(side_by_side) for side_by_side in every)
        return PlantMatrices(*(M.reshape(len(M), m, -1).transpose(1, 0, 2) for M in parts)).delayed(self.delay_s)

    def whole_plants(self, scenarios: FloatArray) -> WholePlants:
        """Continuous plants with forces f_x, f_y on the rotor as further inputs, per mass if the mass is unknown.

        The names of the forces are those of the outputs with ``f`` in place of ``p``.
        """
        G, (A, B, C, D) = self.plant, vars(self.continuous_plants(scenarios)).values()
        mass = self.lpv.machine.moving_mass_kg or 1.0
        E = np.zeros((*A.shape[:2], len(G.C)))
        E[:, : G.n_states] = force_entry(G) / mass
        whole = PlantMatrices(A, np.concatenate([B, E], 2), C, np.concatenate([D, np.zeros_like(C @ E)], 2))
        forces = tuple(name.replace("p", "f", 1) for name in G.output_names)
        return WholePlants(whole, (*G.input_names, *forces), G.output_names, G.input_names, G.output_names)

    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Plant of a scenario, sampled with exact delays."""
        point, changes = scenario[: self.n_variables], scenario[self.n_variables :]
        values = dict(self.lpv.key_parameters(*point))
        for name, change in zip(self.lpv.coefficients, changes, strict=False):
            values[name] += change
        negative = [name for name in ("tau_x", "tau_y") if values.get(name, 1.0) <= 0]
        if negative:
            raise UsageError(
                f"model {self.lpv.name!r}: a drawn plant has {negative[0]} = {values[negative[0]]:g} s; fix the delays"
            )
        try:
            return sample_plant(exact_plant_of(self.lpv, values), sampling.sample_time, sampling.computation_s)
        except UsageError as error:
            raise UsageError(
                f"model {self.lpv.name!r} at {self.lpv.domain.label(*point)}, or a plant drawn around it, cannot be "
                f"sampled: {error}"
            ) from None

    def first(self, points: FloatArray) -> list[int]:
        """Return the indices of the points nearest to the corners of the operating range."""
        low, high = points.min(axis=0), points.max(axis=0)
        unit = (points - low) / np.where(high > low, high - low, 1.0)
        places = product((0.0, 1.0), repeat=points.shape[1])
        return list(dict.fromkeys(int(np.argmin(((unit - corner) ** 2).sum(axis=1))) for corner in places))


_FIRST = 4


@dataclass(frozen=True, eq=False)
class ModelPlants(Plants):
    """Plants given as models; each point is that of a schedule, or zero and the speed, and then the model's index.

    Parameters
    ----------
    models : tuple of LinearModel
        Continuous plants with equal inputs and outputs; delays may be exact.
    unfinished : tuple of FitResult
        Plants that are fits which did not converge.
    whole : tuple of LinearModel
        The models with all their channels.
    """

    models: tuple[LinearModel, ...] = field(kw_only=True)
    whole: tuple[LinearModel, ...] = field(kw_only=True)
    unfinished: tuple[FitResult, ...] = ()

    @property
    def plant(self) -> LinearModel:
        """First model."""
        return self.models[0]

    @property
    def slowest(self) -> tuple[float, ...]:
        """Slowest decay rate [1/s] of each plant, over the oscillatory modes that feedback can move."""
        return tuple(slowest_mode(model.poles(), self.unmoved) for model in self.models)

    @property
    def rate(self) -> float:
        """Slowest oscillation of any model [rad/s]; else the mean of its poles; sqrt(b) of b/s^2."""
        poles = np.concatenate([model.poles() for model in self.models])
        poles = poles[np.abs(poles) > 1e-9 * np.abs(poles).max(initial=0.0)]
        pairs = np.abs(poles[~is_real(poles)])
        if len(poles):
            return float(pairs.min() if len(pairs) else np.exp(np.log(np.abs(poles)).mean()))
        gains = [np.linalg.norm(m.C @ np.linalg.solve(1j * np.eye(len(m.A)) - m.A, m.B)) for m in self.models]
        return float(np.sqrt(min(gains))) or 1.0

    def scenarios(self, points: FloatArray) -> tuple[FloatArray, list[str]]:
        """Points, and the names of the models."""
        labels = [self.models[int(i)].name for i in points[:, -1]]
        if len(set(labels)) < len(labels):
            labels = [f"{name} ({int(i) + 1})" for name, i in zip(labels, points[:, -1], strict=True)]
        return points, labels

    def continuous_plants(self, scenarios: FloatArray) -> PlantMatrices:
        """Continuous models, with Padé delays."""
        models = [with_pade(self.models[int(i)], PADE_ORDER) for i in scenarios[:, -1]]
        return PlantMatrices.stacked(models).delayed(self.delay_s)

    def whole_plants(self, scenarios: FloatArray) -> WholePlants:
        """Continuous models with all their channels.

        Raises
        ------
        UsageError
            When the names of a channel differ between the models.
        """
        models = [self.whole[int(i)] for i in scenarios[:, -1]]
        first = self.whole[0]
        if any((each.input_names, each.output_names) != (first.input_names, first.output_names) for each in models):
            raise UsageError("goals on responses between named signals need models with the same channels")
        plants = PlantMatrices.stacked([with_pade(model, PADE_ORDER) for model in models]).delayed(self.delay_s)
        channels = self.plant.input_names, self.plant.output_names
        return WholePlants(plants, first.input_names, first.output_names, *channels)

    def sampled(self, scenario: tuple[float, ...], sampling: Sampling) -> LinearModel:
        """Model of a scenario, sampled with exact delays."""
        return sample_plant(self.models[int(scenario[-1])], sampling.sample_time, sampling.computation_s)

    def first(self, points: FloatArray) -> list[int]:
        """Return evenly spaced indices of some models."""
        return sorted({round(i) for i in np.linspace(0, len(points) - 1, _FIRST)})


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
        When a model is sampled or has no such channel, or when their number does not fit the controller.
    """
    plants = []
    for model in models:
        if model.dt is not None:
            raise UsageError(
                f"model {model.name!r} is sampled at {model.dt:g} s; give the continuous model, and sample_time"
            )
        columns = channel_places(model.name, "input", model.input_names, inputs)
        rows = channel_places(model.name, "output", model.output_names, outputs)
        for what, n, names in (("outputs", len(columns), structure.outputs), ("inputs", len(rows), structure.inputs)):
            if n != len(names):
                raise UsageError(
                    f"controller {structure.name!r} has {len(names)} {what} ({', '.join(names)}), the plant "
                    f"{model.name!r} {n}; choose channels by inputs= and outputs=, or axes= of the structure"
                )
        delayed = None if model.B_delayed is None else model.B_delayed[:, columns]
        chosen = replace(
            model,
            B=model.B[:, columns],
            C=model.C[rows],
            D=model.D[np.ix_(rows, columns)],
            K=None,
            intersample=None,
            B_delayed=delayed,
            delay=None if model.delay is None else model.delay[columns],
            input_names=tuple(model.input_names[i] for i in columns),
            output_names=tuple(model.output_names[i] for i in rows),
        )
        plants.append(chosen)
    return tuple(plants)


def channel_places(model: str, what: str, names: tuple[str, ...], wanted: Sequence[str] | None) -> list[int]:
    """Return the positions of the wanted channels among the channel names of a model; all by default.

    Raises
    ------
    UsageError
        When a channel is wanted twice, or is not there.
    """
    if wanted is not None and len(set(wanted)) < len(wanted):
        raise UsageError(f"{what}s = {wanted!r}: give each {what} once")
    for name in wanted or ():
        if name not in names:
            raise UsageError(f"model {model!r} has no {what} {name!r}; choose from {', '.join(names)}")
    return list(range(len(names))) if wanted is None else [names.index(name) for name in wanted]


def plants_of(model: PlantsLike, structure: Structure | Scheduled, options: TuneOptions) -> LpvPlants | ModelPlants:
    """Return the plants of a design from an LPV model, a fit, a linear model, or a list of these.

    Raises
    ------
    UsageError
        When a model is of another kind, or when options do not belong to it.
    """
    labels = list(model) if isinstance(model, Mapping) else []
    several = [*model.values()] if isinstance(model, Mapping) else [*model] if isinstance(model, Sequence) else [model]
    if not several:
        raise UsageError("tune: no models")
    given = [each.model if isinstance(each, LPVFit) else each for each in several]
    machines = [each for each in given if isinstance(each, LPVModel)]
    if machines and not isinstance(model, Mapping | Sequence):
        if (options.inputs, options.outputs) != (None, None):
            raise UsageError("tune: inputs and outputs choose channels of linear models; an LPV model has r and p")
        if options.speeds_rpm is not None:
            raise UsageError("tune: speeds_rpm belongs to linear models; an LPV model has operating_points")
        return LpvPlants.of(machines[0], structure, options)
    if len(machines) == len(given) and not (options.inputs or options.outputs or options.uncertainty):
        first, *others = machines
        alike = (first.actuators, first.pade_order, first.domain)
        if all((each.actuators, each.pade_order, each.domain) == alike for each in others):
            return LpvPlants.of(first, structure, options, tuple(others))
    if options.uncertainty is not None:
        raise UsageError("tune: uncertainty belongs to an LPV model; give the drawn models in the list")
    models: list[LinearModel] = []
    for i, each in enumerate(given):
        linear = _linear(each, options)
        if labels:
            linear = [replace(one, name=labels[i] + (f", {one.name}" if linear[1:] else "")) for one in linear]
        models += linear
    speeds = np.zeros(len(models)) if options.speeds_rpm is None else np.array(options.speeds_rpm, float)
    if speeds.shape != (len(models),) or not np.isfinite(speeds).all():
        raise UsageError(f"tune: speeds_rpm = {options.speeds_rpm} for {len(models)} models; give a speed for each")
    if isinstance(structure, Scheduled) and not (options.speeds_rpm and structure.uses <= {"speed_rpm"}):
        raise UsageError(
            f"controller {structure.name!r}: a schedule needs an LPV model, with pressure and speed; for linear models "
            "give speeds_rpm=, and terms of the speed only"
        )
    for name in ("operating_points", "actuator"):
        if getattr(options, name) is not None and not machines:
            raise UsageError(f"tune: {name} belongs to LPV models; leave it out")
    chosen = checked_models(models, structure, options.inputs, options.outputs)
    ranges = structure.domain.ranges if isinstance(structure, Scheduled) else dict.fromkeys(SCHEDULING, (0.0, 0.0))
    place = [speeds if name == "speed_rpm" else np.full(len(chosen), low) for name, (low, _) in ranges.items()]
    points = np.column_stack([*place, np.arange(len(chosen))])
    unfinished = tuple(each for each in given if isinstance(each, FitResult) and not each.success)
    return ModelPlants(
        structure, points, options.delay_s, options.sampling, models=chosen, whole=tuple(models), unfinished=unfinished
    )


def _with_actuators(lpv: LPVModel, actuator: Mapping[str, float] | None) -> LPVModel:
    structure = lpv.structure
    if structure is not None and not isinstance(structure, RotorBearing):
        if actuator is not None:
            raise UsageError(f"tune: actuator belongs to a gas bearing; {structure.name!r} has its own parameters")
        return lpv
    given = lpv.actuators if actuator is None else actuator
    missing = [name for name in ACTUATOR_PARAMETERS if name not in given]
    if missing:
        raise UsageError(f"model {lpv.name!r} has no actuator {', '.join(missing)}; give actuator={{...}}")
    return lpv if actuator is None else replace(lpv, actuators=dict(actuator))


def _linear(given: PlantLike, options: TuneOptions) -> list[LinearModel]:
    """Return the linear models of one list entry: for an LPV model one for each operating point."""
    if isinstance(given, LPVModel):
        machine = _with_actuators(given, options.actuator)
        plant_at = machine.plant_at if options.sampling is None else partial(exact_plant, machine)
        return [plant_at(*point) for point in _points(machine, options.operating_points).tolist()]
    model = given.model if isinstance(given, FitResult) else given
    if not isinstance(model, LinearModel):
        raise UsageError(
            f"tune: a {type(given).__name__} is no plant; give an LPV model, a LinearModel (of a nonlinear one its "
            "linearise(x0, u0)), a fit, or a list of these"
        )
    return [model]


def _points(lpv: LPVModel, given: Sequence[Point] | Literal["domain"] | None) -> FloatArray:
    """Return operating points (m, n_variables), checked; of a domain the corners and middles."""
    if isinstance(given, str):
        return np.array([*product(*((low, (low + high) / 2, high) for low, high in lpv.domain.bounds))])
    points, what = lpv.operating_points if given is None else given, ", ".join(lpv.scheduling)
    try:
        array = np.array([[float(v) for _, v in zip(lpv.scheduling, point, strict=True)] for point in points])
    except (TypeError, ValueError):
        raise UsageError(f"operating_points: give a list of ({what})") from None
    if not len(array):
        raise UsageError(f"model {lpv.name!r} lists no operating points; give operating_points=[({what}), ...]")
    lpv.domain.check(tuple(array.T), f"model {lpv.name!r}")
    return array


def slowest_mode(poles: ComplexArray, unmoved: Sequence[complex] = ()) -> float:
    """Return the slowest decay [1/s] of the oscillatory modes outside `unmoved`; negative if unstable."""
    pairs = poles[~is_real(poles)]
    for rate in unmoved:
        other = np.abs(pairs.real + 1j * np.abs(pairs.imag) - rate) > 1e-6 * abs(rate)
        pairs = pairs[other] if other.any() else pairs
    return float(-pairs.real.max()) if len(pairs) else 0.0
