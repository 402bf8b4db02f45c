"""Result of a search for gains, verified by eigenvalues, exact norms and the distance to instability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np

from gbid.control.controllers.file import ControllerDesign
from gbid.control.controllers.structures import Scheduled
from gbid.control.loop.close import Method
from gbid.control.loop.norm import Peak, largest_singular_values, peak_gain
from gbid.control.tuning.design_options import Objective
from gbid.control.tuning.loops import LoopFamily
from gbid.control.tuning.plane import damping_factors, eigenvalues, true_rates
from gbid.control.tuning.problem import FEASIBLE, GainProblem, SearchStep, rows_of
from gbid.core.arrays import FloatArray, Point
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.extras import data_frame
from gbid.core.hdf5 import NOT_STORED, Stored
from gbid.structure import LinearModel

SAME_DESIGN = 0.02
"""Relative difference below which the values of independent searches count as alike: no rig shows less."""
Points = Annotated[tuple[Point, ...], Stored("bar, rpm", "operating points of the design")]


class GainStatus(StrEnum):
    """Reason why a search for gains ended."""

    OPTIMAL = "optimal"
    """All limits hold, the design is a certified local optimum, and other starts lead to no better one.

    The search began with a grid over the whole box (up to three gains), or at least three independent searches (`seeds`
    of `gbid.tune`) ended in this design.
    """
    LOCAL_OPTIMUM = "local optimum"
    """All limits hold, and no small change of the gains improves the design, which is certified.

    With more than three gains another seed may find a better one: see `seeds` of `gbid.tune`.
    """
    STALLED = "stalled"
    """All limits hold, and no method improved the design any more, but it has no certificate."""
    ITERATION_LIMIT = "iteration limit"
    """The budget or the iterations ended before there was a certificate; `violation` tells whether all limits hold."""
    LIMITS_CONTRADICT = "infeasible"
    """Stable, but the search ended by itself without a design that keeps all limits."""
    NO_STABILISING_GAINS = "no stabilising gains"
    """No gains within the bounds were found that stabilise all loops."""


@dataclass(frozen=True)
class WorstMode:
    """Mode that limits a design.

    Attributes
    ----------
    where : str
        Loop of the mode: an operating point, or ``A[i]``.
    frequency_hz : float
        Natural frequency [Hz]; 0 for a pole at zero.
    damping : float
        Damping factor; -1 for an unstable real pole.
    """

    where: str
    frequency_hz: float
    damping: float

    @classmethod
    def of(cls, where: str, rate: complex) -> WorstMode:
        """Return the mode of a pole.

        Parameters
        ----------
        where : str
            Place of the loop.
        rate : complex
            The pole in continuous time [rad/s].
        """
        return cls(where, abs(rate) / (2 * np.pi), -rate.real / abs(rate) if rate else 0.0)

    def value(self, objective: Objective) -> float:
        """Return damping factor or decay [1/s] of the mode, as the `objective` says."""
        return self.damping if objective == "damping" else 2 * np.pi * self.frequency_hz * self.damping


@dataclass(frozen=True)
class GoalFigure:
    """Value that a design reached for one of its goals.

    Attributes
    ----------
    name : str
        Name of the goal.
    soft : bool
        Whether it was an objective.
    excess : float
        Logarithm of its value over its limit; of damping factors the limit minus the value. At most 0 where it is met.
    where : str
        Loop in which it is largest.
    """

    name: str
    soft: bool
    excess: Annotated[float, Stored("1", "value over limit, as a logarithm")]
    where: str


@dataclass(frozen=True)
class GainResult(Brief):
    """Gains found by `gbid.maximise_damping` or `gbid.tune`, with verified performance figures.

    Attributes
    ----------
    gains : dict of str to float
        Gains by name.
    value : float
        Smallest damping factor of the oscillatory modes over all loops, or slowest decay [1/s]; computed from the
        eigenvalues of the final matrices. Modes that no gain moves do not count: the notes name them. Of an unstable
        design that of its worst pole, see `worst`.
    objective : {"damping", "decay", "goals"}
        Quantity that was maximised. ``"goals"``: the smallest of minus the excesses of the soft goals, which `value`
        then is.
    status : GainStatus
        Why the search ended. When limits are exceeded or no gains stabilise, the gains are those with the smallest
        violation found.
    violation : float
        Largest relative violation of a limit; 0 when all limits hold.
    verified_on : str
        How the result was verified.
    worst : WorstMode
        Mode that limits the design.
    active : tuple of str
        Limits and bounds that are active at the design.
    notes : tuple of str
        Remarks for the user of the design, in sentences.
    peak_sensitivity, peak_control, static_amplification : float, optional
        Largest peaks of S_o and K S_o over frequency and loops, largest gain of S_o at zero frequency; None when not
        known.
    sample_time : float, optional
        Sample time of a design for the sampled loop [s]; value and peaks are of that loop. None for the continuous
        loop.
    computation_s, method : float and str, optional
        Computation time [s] and discretisation of a design for the sampled loop.
    history : tuple of SearchStep
        Progress of the search.
    points : tuple of (pressure_bar, speed_rpm), or of other scheduling variables
        Operating points of the design, with worst points that were added; empty for given matrices.
    goals : tuple of GoalFigure
        What was reached of goals other than damping, decay, and the three figures above.
    controller : Structure or Scheduled, optional
        Structure of the gains.
    certificate_gain : float, optional
        Certificate of optimality: share of its value by which the objective would rise to first order if the gains
        changed by their own size, the length of the shortest convex combination of gradients. ``OPTIMAL`` needs at most
        0.002. None when the design was not certified.
    certificate_radius : float, optional
        Radius of the ball from which the gradients were taken, in sizes of the gains; 0: from the design itself.
    certificate_room : float, optional
        Share of its value by which the objective could still rise within the ball, or if eigenvalues that are near each
        other met. ``OPTIMAL`` needs at most 0.005.
    seed_values : tuple of float
        Value of each independent search, in the order of their seeds; NaN where it kept not all limits. Empty for up
        to three gains, whose search begins with a grid over the whole box.
    """

    gains: Annotated[Mapping[str, float], Stored("", "gains", "gains")]
    value: float
    objective: str
    status: GainStatus
    violation: float
    verified_on: str
    worst: WorstMode
    active: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    peak_sensitivity: float | None = None
    peak_control: float | None = None
    static_amplification: float | None = None
    sample_time: float | None = None
    history: tuple[SearchStep, ...] = field(default=(), repr=False)
    points: Points = field(default=(), repr=False)
    goals: tuple[GoalFigure, ...] = ()
    controller: Annotated[Any, NOT_STORED] = field(default=None, repr=False)
    certificate_gain: float | None = None
    certificate_radius: float | None = None
    certificate_room: float | None = None
    computation_s: float | None = None
    method: Method | None = None
    seed_values: Annotated[tuple[float, ...], Stored("", "value of each independent search")] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "gains", MappingProxyType(dict(self.gains)))

    @property
    def success(self) -> bool:
        """Whether the design is stable, satisfies all limits, and is a certified local optimum."""
        return self.status in (GainStatus.OPTIMAL, GainStatus.LOCAL_OPTIMUM)

    @property
    def keeps_limits(self) -> bool:
        """Whether the design is stable and satisfies all limits, with or without a certificate."""
        ended = self.status in (GainStatus.STALLED, GainStatus.ITERATION_LIMIT) and self.violation <= FEASIBLE
        return self.success or ended

    @property
    def optimality(self) -> str:
        """Text on optimality: certified local optimum or not, and how many independent searches agree."""
        local = f"{self.status}, certified".replace("optimal", "optimum") if self.success else "no certified optimum"
        n = len(self.seed_values)
        if not n:
            return f"{local}; searched from a grid over all bounds"
        if n == 1:
            return f"{local}; one search, other seeds were not tried"
        best = np.nanmax([*self.seed_values, -np.inf])
        near = sum(value >= best - SAME_DESIGN * abs(best) for value in self.seed_values)
        return f"{local}; the best of {n} independent searches, {near} of them within {100 * SAME_DESIGN:g} %"

    def design(
        self, *, name: str = "", sample_time: float | None = None, method: Method | None = None, plant: str = ""
    ) -> ControllerDesign:
        """Return the controller of this result, with its structure, gains and sampling.

        Parameters
        ----------
        name : str
            Name of the design; by default that of the structure.
        sample_time : float, optional
            Sample time of the target [s], for a continuous design only; files and targets need it.
        method : {"tustin", "zoh"}, optional
            Method of discretisation, for a continuous design only; by default ``"tustin"``.
        plant : str
            Name of the model for which it was designed.

        Raises
        ------
        UsageError
            When the design stabilises nothing, has no structure, or was made for another sample time or method.
        """
        structure = self.controller
        if self.status is GainStatus.NO_STABILISING_GAINS or structure is None:
            why = self.status if structure is not None else "a result without its structure"
            raise UsageError(f"this design is no controller for a machine: {why}")
        for what, given, own in (("sample_time", sample_time, self.sample_time), ("method", method, self.method)):
            if given is not None and own is not None and given != own:
                raise UsageError(f"{structure.name!r} was designed for {what} = {own}, not {given}; leave {what} out")
        design = ControllerDesign(
            name or structure.name,
            structure,
            dict(self.gains),
            self.sample_time if sample_time is None else sample_time,
            method or self.method or "tustin",
            {parameter.name: parameter.unit for parameter in structure.parameters},
            plant,
            {"status": str(self.status), self.objective: self.value, "verified_on": self.verified_on},
        )
        keys = self.points if isinstance(structure, Scheduled) else ()
        return replace(design, models={key: design.at(*(key or ())) for key in keys or (None,)})

    def _brief(self) -> Description:
        known = {
            name: getattr(self, name)
            for name in ("peak_sensitivity", "peak_control", "static_amplification", "sample_time")
            if getattr(self, name) is not None
        }
        return brief(
            self,
            f"{self.objective} {self.value:.6g}, {self.status}",
            gains=self.gains,
            search=self.optimality,
            **known,
            worst=f"{self.worst.where}, {self.worst.frequency_hz:.5g} Hz, damping {self.worst.damping:.4g}",
            active=self.active,
            verified_on=self.verified_on,
            notes=self.notes,
        )

    def to_frame(self) -> Any:
        """Return the gains as a data frame with one column.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        return data_frame({"gain": list(self.gains), "value": list(self.gains.values())}, index="gain")


# ---- Verification of a design: eigenvalues, exact norms, and distance to instability.


def exact_norms(family: LoopFamily, x: FloatArray, kind: str, least: float = 0.0) -> list[Peak]:
    """Return the H-infinity norms of S_o (``"sensitivity"``) or K S_o (``"control"``) of every loop.

    Norms below `least` may be too small, but take less time.
    """
    return [peak_gain(model, least=least) for model in _models(family, x, kind)]


def largest_norm(family: LoopFamily, x: FloatArray, kind: str) -> float:
    """Return the largest of the H-infinity norms of all loops."""
    largest = 0.0
    for model in _models(family, x, kind):
        largest = max(largest, peak_gain(model, least=largest).value)
    return largest


def _models(family: LoopFamily, x: FloatArray, kind: str) -> list[LinearModel]:
    loops, rows = family.matrices(x), rows_of(family, kind)
    parts = zip(loops.A, loops.B, loops.C[:, rows], loops.D[:, rows], strict=True)
    return [LinearModel(A, B, C, D) for A, B, C, D in parts]


def static_gains(family: LoopFamily, x: FloatArray) -> FloatArray:
    """Return the largest gain of S_o at zero frequency of every loop, (m,)."""
    loops, rows = family.matrices(x), rows_of(family, "static")
    response = loops.C[:, rows] @ np.linalg.solve(-loops.A, loops.B) + loops.D[:, rows]
    return np.asarray(largest_singular_values(response.astype(complex)))


def worst_mode(problem: GainProblem, x: FloatArray) -> WorstMode:
    """Return the mode that limits a design: an unstable pole, else the mode with smallest damping or slowest decay."""
    worst: tuple[float, str, complex] | None = None
    for family in problem.families:
        values = true_rates(eigenvalues(family.states(x)), family.sample_time)
        aim = problem.aim(values, family.sample_time) if problem.limits.weight else damping_factors(values)
        # a pole that grows is worse than any that does not
        rank = np.where(values.real < problem.edge, aim, -2.0 - values.real / problem.scale)
        rank = np.where(np.isnan(values), -np.inf, rank)
        i, j = np.unravel_index(rank.argmin(), rank.shape)
        if worst is None or rank[i, j] < worst[0]:
            worst = (float(rank[i, j]), family.labels[i], complex(values[i, j]))
    assert worst is not None
    _, where, value = worst
    return WorstMode.of(where, value)


@dataclass(frozen=True)
class Edge:
    """Smallest change of a single gain that makes a loop unstable; infinite when it exceeds the width of the bounds."""

    gain: str
    change: float


def distance_to_edge(problem: GainProblem, x: FloatArray, names: tuple[str, ...]) -> Edge:
    """Return the smallest destabilising change of a single gain of either sign, with a tolerance of 1 %."""
    nearest = Edge("", np.inf)
    for i, name in enumerate(names):
        for step in np.eye(len(x))[i] * [[1.0], [-1.0]]:
            low = 0.0
            for high in (problem.upper[i] - problem.lower[i]) * np.geomspace(1e-7, 1.0, 22):
                if high >= abs(nearest.change):
                    break
                if problem.stable(x + high * step):
                    low = high
                    continue
                while high - low > 0.01 * high:
                    middle = (low + high) / 2
                    low, high = (middle, high) if problem.stable(x + middle * step) else (low, middle)
                nearest = Edge(name, float(high * step[i]))
                break
    return nearest
