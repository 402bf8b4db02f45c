"""Recursive estimates of plant parameters under control: regressors of a noise-free twin, square-root information."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import ceil, cos, log, sin
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy

from gbid.control import ControllerDesign, GainResult, close_loop
from gbid.control.loop.close import force_entry, sample_plant
from gbid.control.tuning.plants import checked_models
from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.option_types import NotNegative, Positive, checks_arguments
from gbid.core.tables import Column, Table
from gbid.discretise import discretise
from gbid.identify import FitResult
from gbid.recording import Recording
from gbid.structure import LinearModel

UNBALANCE = ("e_cos", "e_sin")
"""Unbalance per moving mass along the zero of the encoder and a quarter of a turn on [m], which may be parameters."""
MEMORIES = 10.0
"""Least forgetting time, in memories of the predictor: a faster recursion excites itself."""
WARM_UP = 5.0
"""Time without learning after a start, in memories of the predictor."""
OUTLIER = 3.0
"""Residuals beyond this many standard deviations are clipped (Huber)."""
SCALE_OF_MEAN = 1.2533141373155001
"""Standard deviation over mean magnitude of a Gaussian variable."""
EXCITED = 0.25
"""Largest information-matrix variance over that of the prior with which a parameter counts as excited."""
PRIOR_UNBALANCE_M = 1e-6
"""Standard deviation of the prior of the unbalance per moving mass [m]."""
_MOST_CORNERS = 6


class LearnTables(NamedTuple):
    """Constants of the recursion, at the estimates of the fit; parameters count in standard deviations of the prior.

    Attributes
    ----------
    A, G, C : (n, n), (n, m), (n_y, n) array
        Sampled plant; G is the matrix of the last inputs, the newest first.
    K, F : (n, n_y), (n, n) array
        Gain of the observer and its state matrix ``A - K C``.
    slopes : (n_p, n, n + m) array
        Derivatives of ``[A G]`` by the parameters of the plant.
    E : (n, n_y) array
        Effect of a force per mass; zero without unbalance among the parameters.
    whiten : (n_y, n_y) array
        Matrix that gives the innovations of the fit unit covariance.
    law : LinearModel
        Sampled controller.
    first : int
        States before it, such as those of actuators, depend neither on the parameters nor on the states after them.
    """

    A: FloatArray
    G: FloatArray
    C: FloatArray
    K: FloatArray
    F: FloatArray
    slopes: FloatArray
    E: FloatArray
    whiten: FloatArray
    law: LinearModel
    first: int


@dataclass(frozen=True)
class LearnSample:
    """Sample of a recursion.

    Attributes
    ----------
    position : tuple of float
        Outputs p that the controller measures.
    reference, dither : tuple of float
        r as it acts from this sample on, and the known excitation in it.
    angle, speed_rpm : float
        Shaft angle [rad] and speed [rpm], for the unbalance.
    is_good : bool
        Whether position and reference are to be learnt from; else the predictor runs on without the position.
    """

    position: tuple[float, ...]
    reference: tuple[float, ...]
    dither: tuple[float, ...]
    angle: float = 0.0
    speed_rpm: float = 0.0
    is_good: bool = True


@dataclass(frozen=True, eq=False)
class RecursiveResult(Brief, Pictured):
    """Estimates over time of a recursion.

    Attributes
    ----------
    names, units : tuple of str
        Parameters and their units.
    time_s : (n,) array
        Times of the estimates [s].
    estimates, std : (n, n_parameters) array
        Estimates and standard deviations.
    excited : (n, n_parameters) array of bool
        Whether the dither determines the parameter; else its standard deviation is about that of the prior.
    modes : (n, n_modes, 2) array
        Natural frequency [Hz] and damping factor of each mode of the plant.
    dither : tuple of float
        Root mean square of the dither of each input.
    alarm : (n,) array of bool
        Whether a parameter is at the border of the set for which the loop was checked.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    time_s: FloatArray
    estimates: FloatArray
    std: FloatArray
    excited: np.ndarray
    modes: FloatArray
    dither: tuple[float, ...]
    alarm: np.ndarray

    drawn_by = "plot_recursive_fit"

    def _brief(self) -> Description:
        rows = {
            name: f"{v:.6g} +- {s:.2g}" for name, v, s in zip(self.names, self.estimates[-1], self.std[-1], strict=True)
        }
        return brief(self, f"{self.time_s[-1]:g} s", dither=self.dither, alarm=bool(self.alarm.any()), **rows)

    def tables(self) -> list[Table]:
        """Return a table of the parameters: first and last estimate, deviation, and whether it is excited."""
        columns = [Column("parameter"), Column("first", format=5), Column("last", format=5), Column("std", format=2)]
        rows: list[list[Any]] = [
            [name, first, last, std, unit, "yes" if excited else "no"]
            for name, first, last, std, unit, excited in zip(
                self.names,
                self.estimates[0],
                self.estimates[-1],
                self.std[-1],
                self.units,
                self.excited[-1],
                strict=True,
            )
        ]
        return [Table("", [*columns, Column("unit"), Column("excited")], rows)]

    def figures(self) -> list[Figure]:
        """Return the estimates over time with their intervals."""
        return [Figure("plot_recursive_fit", f"Recursive estimates of {', '.join(self.names)} over time", (self,))]


class RecursiveFit:
    r"""Estimates of plant parameters while the loop runs, by exponential forgetting.

    .. math:: R_k = \lambda R_{k-1} + (1 - \lambda) R_0 + \psi_k \psi_k^T, \qquad
              \hat\theta_k = \hat\theta_{k-1} + R_k^{-1} \psi_k\, \varepsilon_k(\hat\theta_{k-1})

    The residuals come from the predictor at the present estimates. The regressors psi come from a noise-free twin of
    the loop, driven by the dither alone, so that noise under feedback moves no estimate: without dither nothing
    moves, and the standard deviations return to those of the prior. R is kept as its square root, which rows
    update by Givens rotations.

    Parameters
    ----------
    result : FitResult
        Fit of the plant from the references of the controller to what it measures, such as a `gbid.Plant`.
    controller : ControllerDesign, GainResult or LinearModel
        Sampled controller with constant gains; of a scheduled one the model at the operating point.
    parameters : sequence of str
        Estimated parameters of the fit to follow, and ``"e_cos"``, ``"e_sin"``: the unbalance per moving mass [m]. A
        shaft that turns with unbalance needs these two; else stiffness takes its place.
    forgetting_s : float
        Time constant of the forgetting [s].
    dither : float
        Amplitude of the binary excitation that the chain in C adds [m, or the unit of the references]; 0 for none. A
        recording has its excitation in ``w``.
    hold_s : float
        Time between the levels of this excitation [s].
    memory_s : float, optional
        Memory of the predictor: time constant of its slowest pole [s]. A Kalman gain for forces on the rotor is then
        used; by default the disturbance gain of the fit.
    prior : float
        Standard deviation of the prior, as a share of each estimate; of the unbalance it is 1 um.
    bound : float
        Half-width of the set in which estimates stay, as a share of each estimate. The loop and the predictor must be
        stable on all its corners.

    Attributes
    ----------
    names, units : tuple of str
        Parameters and their units.
    start, prior_std, bounds : (n,) array
        Estimates of the fit, standard deviations of the prior, and half-widths of the set.
    memory_s : float
        Memory of the predictor that is used [s].
    tables : LearnTables
        Constants of the recursion.

    Raises
    ------
    UsageError
        When a parameter was not estimated or acts on the outputs directly, when the forgetting time is shorter than ten
        memories of the predictor, when loop or predictor are unstable within the bounds, or when channels do not fit.

    Notes
    -----
    With exponential forgetting the inverse of R is twice the variance of the estimates, in units of the innovations.
    A drift faster than its size over `forgetting_s` adds a lag that no standard deviation contains.
    """

    @checks_arguments
    def __init__(
        self,
        result: FitResult,
        controller: ControllerDesign | GainResult | LinearModel,
        *,
        parameters: Sequence[str],
        forgetting_s: Positive = 1.0,
        dither: NotNegative = 0.0,
        hold_s: Positive = 2e-3,
        memory_s: Positive | None = None,
        prior: Positive = 0.1,
        bound: Positive = 0.2,
    ) -> None:
        design = controller.design() if isinstance(controller, GainResult) else controller
        law = design.sampled_at() if isinstance(design, ControllerDesign) else design
        uncertain = result.uncertain_model
        slopes, _ = uncertain.known()
        known = [name for name in parameters if name not in UNBALANCE]
        missing = [name for name in known if name not in result.free]
        if missing or not known or len(set(parameters)) < len(parameters):
            raise UsageError(
                f"RecursiveFit: parameters = {list(parameters)}; choose from {', '.join((*result.free, *UNBALANCE))}, "
                "each once and at least one of the plant",
                "parameters",
            )
        if law.dt is None:
            raise UsageError(
                "RecursiveFit: the controller is continuous; give the sampled one (sampled_at)", "controller"
            )
        self.names = tuple(sorted(parameters, key=UNBALANCE.__contains__))
        self.units = tuple(result.units.get(name, "m") for name in self.names)
        self.sample_time, self.forgetting_s, self.dither = float(law.dt), forgetting_s, dither
        self.hold_samples = max(1, round(hold_s / self.sample_time))
        self.start = np.array([result.parameters.get(name, 0.0) for name in self.names])
        sizes = np.abs(self.start)
        self.prior_std = np.where([n in UNBALANCE for n in self.names], PRIOR_UNBALANCE_M, prior * sizes)
        self.bounds = np.where([n in UNBALANCE for n in self.names], 10 * PRIOR_UNBALANCE_M, bound * sizes)
        if (self.prior_std == 0).any():
            raise UsageError(
                "RecursiveFit: a parameter is zero, so that its prior and bounds have no size", "parameters"
            )
        places = [result.free.index(name) for name in known]
        self._model, self._places, self._slopes = uncertain.model, places, slopes
        self.tables = self._tables(law, result, memory_s)
        self._check()
        self.restart()
        self.estimate = np.zeros(len(self.names))  # in standard deviations of the prior

    # ---- Constants

    def plant(self, values: FloatArray) -> LinearModel:
        """Return the continuous plant at values of the parameters, (n,); the unbalance has no effect.

        Parameters
        ----------
        values : (n,) array
            Values in the order of `names`.
        """
        moves = np.asarray(values)[: len(self._places)] - self.start[: len(self._places)]
        letters = ("A", "B", "C", "D") if self._model.delay is None else ("A", "B", "C", "D", "B_delayed", "delay")
        change = {a: np.tensordot(moves, getattr(self._slopes, a)[self._places], 1) for a in letters}
        return replace(self._model, **{a: getattr(self._model, a) + change[a] for a in letters})

    def _sampled(self, law: LinearModel, values: FloatArray) -> tuple[LinearModel, LinearModel]:
        """Return the plant with the channels of the controller, continuous and sampled without computation time."""
        plant = self.plant(values)
        channels: Any = SimpleNamespace(name=law.name, inputs=law.input_names, outputs=law.output_names)
        named = set(law.input_names) <= set(plant.output_names) and set(law.output_names) <= set(plant.input_names)
        (plant,) = checked_models([plant], channels, *((law.output_names, law.input_names) if named else (None, None)))
        return plant, sample_plant(plant, self.sample_time)

    def _tables(self, law: LinearModel, result: FitResult, memory_s: float | None) -> LearnTables:
        model, n_p = self._model, len(self._places)
        plant, held = self._sampled(law, self.start)
        n = plant.n_states
        rows = [model.output_names.index(name) for name in plant.output_names]
        if held.D.any() or held.C[:, n:].any():
            raise UsageError("RecursiveFit: the plant has direct feedthrough; add the actuator or a delay", "result")

        def parts(values: FloatArray, depth: int) -> FloatArray:
            sampled = self._sampled(law, values)[1]
            wide = np.hstack([sampled.A[:n, :n], sampled.B[:n], sampled.A[:n, n:]])
            return np.pad(wide, ((0, 0), (0, n + depth - wide.shape[1])))

        steps = [1e-4 * size * np.eye(len(self.start))[i] for i, size in enumerate(self.prior_std[:n_p])]
        depth = held.n_states - n + len(law.output_names)
        if any(
            self._sampled(law, self.start + sign * step)[1].n_states > held.n_states
            for step in steps
            for sign in (-1, 1)
        ):
            depth += len(law.output_names)
        slopes = [(parts(self.start + step, depth) - parts(self.start - step, depth)) / 2e-4 for step in steps]
        wide = parts(self.start, depth)
        A, G, C = wide[:, :n], wide[:, n:], plant.C
        if any(np.abs(self._slopes.C[i]).any() or np.abs(self._slopes.D[i]).any() for i in self._places):
            raise UsageError("RecursiveFit: a parameter acts on the outputs directly; leave it out", "parameters")
        # columns of the gain for outputs that are not measured here are left out
        K = np.zeros((n, len(C))) if model.K is None else np.asarray(model.K)[:, rows]
        K = discretise(np.array(plant.A), np.array(K), self.sample_time, "zoh").G_now
        E, covariance = np.zeros((n, len(C))), np.asarray(result.error_covariance)[np.ix_(rows, rows)]
        if set(self.names) & set(UNBALANCE) or memory_s is not None:
            E = discretise(np.array(plant.A), force_entry(plant), self.sample_time, "zoh").G_now
        if memory_s is not None:
            K = _gain_of_memory(A, C, E, covariance, self.sample_time, memory_s)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        moved = np.abs(slopes).sum(axis=(0, 2)) + np.abs(E).sum(axis=1)
        first = next((i for i in range(int(np.argmax(moved > 0)), 0, -1) if not A[:i, i:].any()), 0)
        K = np.where(np.arange(n)[:, None] < first, 0.0, K)
        return LearnTables(A, G, C, K, A - K @ C, np.array(slopes), E, whiten, law, first)

    def _check(self) -> None:
        """Refuse a forgetting time that is too short, and bounds within which loop or predictor are unstable."""
        t, n = self.tables, len(self._places)
        self.memory_s = _memory(t.F, self.sample_time)
        if self.forgetting_s < (1 - 1e-6) * MEMORIES * self.memory_s:
            raise UsageError(
                f"RecursiveFit: forgetting_s = {self.forgetting_s:g} s is shorter than ten memories of the predictor "
                f"({MEMORIES * self.memory_s:.3g} s); forget more slowly, or give a shorter memory_s",
                "forgetting_s",
            )
        if n <= _MOST_CORNERS:
            corners = np.array(list(product((-1.0, 1.0), repeat=n)))
        else:
            corners = np.vstack([np.eye(n), -np.eye(n)])
        late = replace(t.law, name="law")
        for corner in corners:
            values = self.start + np.pad(corner, (0, len(self.start) - n)) * self.bounds
            moved = t.A + np.tensordot((values - self.start)[:n] / self.prior_std[:n], t.slopes, 1)[:, : len(t.A)]
            held = sample_plant(self._sampled(t.law, values)[0], self.sample_time, self.sample_time)
            loop = close_loop(held, late)
            if np.abs(np.linalg.eigvals(moved - t.K @ t.C)).max() >= 1 or not loop.is_stable():
                words = ", ".join(f"{name} {v:+.3g}" for name, v in zip(self.names, values, strict=True))
                raise UsageError(
                    f"RecursiveFit: loop or predictor are unstable within the bounds, at {words}; give a smaller bound",
                    "bound",
                )

    # ---- Recursion

    @property
    def warm_samples(self) -> int:
        """Samples after a start without learning."""
        return ceil(WARM_UP * self.memory_s / self.sample_time)

    def fresh(self) -> RecursiveFit:
        """Return the recursion at its start."""
        result = copy.copy(self)
        result.estimate = np.zeros(len(self.names))
        result.restart()
        return result

    def restart(self) -> None:
        """Set predictor, twin and information to rest; the estimates stay."""
        t, n_all = self.tables, len(self.names)
        n, m, n_y, n_r = len(t.A), t.G.shape[1], len(t.C), len(t.law.output_names)
        self._x, self._twin, self._inputs, self._twin_inputs = np.zeros(n), np.zeros(n), np.zeros(m), np.zeros(m)
        self._law_state, self._law_output = np.zeros(t.law.n_states), np.zeros(n_r)
        self._sensitivity, self._offset = np.zeros((n_all, n)), np.zeros(n_y)
        self._upper, self._diagonal = np.eye(n_all).tolist(), [1.0] * n_all
        self._scale, self._warm, self._turn, self.alarm = 1.0, 0, 0, False
        self._relative_std, self._excited = np.ones(n_all), np.zeros(n_all, bool)

    @property
    def values(self) -> FloatArray:
        """Present estimates, (n,)."""
        return np.asarray(self.start + self.estimate * self.prior_std)

    @property
    def std(self) -> FloatArray:
        """Present standard deviations, (n,)."""
        return self._relative_std * self.prior_std

    @property
    def excited(self) -> np.ndarray:
        """Whether the dither determines each parameter, (n,)."""
        return self._excited.copy()

    def update(self, sample: LearnSample) -> None:
        """Move the estimates by one sample.

        Parameters
        ----------
        sample : LearnSample
            The sample.
        """
        t, n_p = self.tables, len(self._places)
        n_r = len(sample.reference)
        self._inputs[n_r:] = self._inputs[:-n_r].copy()
        self._inputs[:n_r] = sample.reference
        error = np.asarray(sample.position) - t.C @ self._x if sample.is_good else np.zeros(len(t.C))
        share = self.sample_time / self.forgetting_s
        white = t.whiten @ error
        residual = white - self._offset
        learns = sample.is_good and self._warm >= self.warm_samples
        self._warm = min(self._warm + 1, self.warm_samples)
        if learns:
            self._offset = self._offset + share * residual
            residual = np.clip(residual, -OUTLIER * self._scale, OUTLIER * self._scale)
            self._scale += share * (SCALE_OF_MEAN * float(np.abs(residual).sum()) / len(residual) - self._scale)
            regressors = self._sensitivity @ (t.whiten @ t.C).T
            self._learn(regressors, residual, share)
        # twin of the loop, driven by the dither alone
        seen = t.C @ self._twin
        acting = self._law_output + sample.dither
        self._twin_inputs[n_r:] = self._twin_inputs[:-n_r].copy()
        self._twin_inputs[:n_r] = acting
        law, wide = t.law, np.concatenate([self._twin, self._twin_inputs])
        drives = np.zeros_like(self._sensitivity)
        drives[:n_p] = t.slopes @ wide
        self._twin = t.A @ self._twin + t.G @ self._twin_inputs
        self._law_output = law.C @ self._law_state + law.D @ seen
        self._law_state = law.A @ self._law_state + law.B @ seen
        # predictor at the present estimates
        own = t.slopes @ np.concatenate([self._x, self._inputs])
        following = t.A @ self._x + t.G @ self._inputs + t.K @ error + self.estimate[:n_p] @ own
        for i, force in self._forces(sample):
            drives[i] = t.E @ force
            following = following + self.estimate[i] * drives[i]
        self._x = following
        self._sensitivity = self._sensitivity @ t.F.T + drives

    def _forces(self, sample: LearnSample) -> list[tuple[int, FloatArray]]:
        """Return the positions of the unbalance parameters, and their forces per mass in the middle of a sample."""
        omega = sample.speed_rpm * np.pi / 30
        angle = sample.angle + 0.5 * omega * self.sample_time
        size = omega * omega * PRIOR_UNBALANCE_M
        c, s = size * cos(angle), size * sin(angle)
        forces = {"e_cos": np.array([c, s]), "e_sin": np.array([-s, c])}
        return [(i, forces[name]) for i, name in enumerate(self.names) if name in forces]

    def _learn(self, regressors: FloatArray, residual: FloatArray, share: float) -> None:
        """Update the square root ``U' D U`` of the information by rows (Gentleman), and step the estimates."""
        upper, diagonal, n = self._upper, self._diagonal, len(self.names)
        right, turn, unit = [0.0] * n, self._turn, [0.0] * n
        unit[turn] = 1.0
        for i in range(n):
            diagonal[i] *= 1.0 - share
        rows = zip(
            [unit, *regressors.T.tolist()], [0.0, *residual.tolist()], [n * share] + [1.0] * len(residual), strict=True
        )
        for given, value, weight in rows:
            row = list(given)
            for i in range(n):
                x, own = row[i], upper[i]
                larger = diagonal[i] + weight * x * x
                c, s = diagonal[i] / larger, weight * x / larger
                diagonal[i], weight = larger, c * weight
                right[i], value = c * right[i] + s * value, value - x * right[i]
                for j in range(i + 1, n):
                    own[j], row[j] = c * own[j] + s * row[j], row[j] - x * own[j]
        step = _solved(upper, right)
        bounds = (self.bounds / self.prior_std).tolist()
        moved = [min(max(a + b, -most), most) for a, b, most in zip(self.estimate.tolist(), step, bounds, strict=True)]
        self.estimate, self.alarm = np.array(moved), any(abs(v) >= most for v, most in zip(moved, bounds, strict=True))
        # one column of the inverse of the information at each sample
        column = unit
        for i in range(n):
            for j in range(i):
                column[i] = column[i] - upper[j][i] * column[j]
        scaled = [v / d for v, d in zip(column, diagonal, strict=True)]
        inverse = sum(v * w for v, w in zip(column, scaled, strict=True))
        square = sum(v * v for v in _solved(upper, scaled))
        half = 0.5 * self._scale * self._scale
        variance, last = half * inverse + (1.0 - half) * square, self._relative_std[turn]
        self._relative_std[turn] = 0.5 * (last + variance / last)  # a step of Newton towards the square root
        self._excited[turn] = inverse < EXCITED
        self._turn = (turn + 1) % n

    def run(self, recording: Recording, *, every_s: Positive = 0.02) -> RecursiveResult:
        """Return the estimates over a recording in closed loop.

        Parameters
        ----------
        recording : Recording
            Signals r (as applied), p (without run-out), w (the dither in r); and phi and speed for the unbalance.
        every_s : float
            Time between the estimates that are kept [s].

        Returns
        -------
        RecursiveResult

        Raises
        ------
        UsageError
            When a signal is missing, or when the sample time is not that of the controller.
        """
        needed = ["r", "p", "w", *(["phi"] if set(self.names) & set(UNBALANCE) else [])]
        missing = [name for name in needed if name not in recording.signals]
        if missing or not np.isclose(recording.sample_time, self.sample_time, rtol=1e-6):
            raise UsageError(
                f"RecursiveFit: recording {recording.name!r} is sampled at {recording.sample_time:g} s and lacks "
                f"{', '.join(missing) or 'no signal'}; give {', '.join(needed)}, every {self.sample_time:g} s"
            )
        r, p, w = (recording.signal(name).tolist() for name in ("r", "p", "w"))
        n, still = len(r), np.zeros((len(r), 1))
        angle = recording.signals.get("phi", still)[:, 0].tolist()
        speed = recording.signals.get("speed_rpm", still + recording.conditions.get("speed_rpm", 0.0))[:, 0].tolist()
        every, kept = max(1, round(every_s / self.sample_time)), []
        for k in range(n):
            self.update(LearnSample(tuple(p[k]), tuple(r[k]), tuple(w[k]), angle[k], speed[k]))
            if (k + 1) % every == 0:
                kept.append((k + 1, self.values, self.std, self.excited, self.alarm))
        if not kept:
            raise UsageError(f"RecursiveFit: recording {recording.name!r} is shorter than every_s = {every_s:g} s")
        count, values, std, excited, alarm = (np.array(part) for part in zip(*kept, strict=True))
        modes = np.array([self.plant(each).modes() for each in values])
        size = tuple(np.sqrt(np.mean(np.square(recording.signal("w")), axis=0)).tolist())
        return RecursiveResult(
            self.names, self.units, count * self.sample_time, values, std, excited, modes, size, alarm
        )


def _memory(F: FloatArray, sample_time: float) -> float:
    """Return the time constant of the slowest pole [s]; infinite for an unstable matrix."""
    radius = float(np.abs(np.linalg.eigvals(F)).max(initial=0.0))
    return float("inf") if radius >= 1 else sample_time / -log(max(radius, 1e-300))


def _gain_of_memory(
    A: FloatArray, C: FloatArray, E: FloatArray, covariance: FloatArray, sample_time: float, memory_s: float
) -> FloatArray:
    """Return the Kalman gain for white forces on the rotor of the size that gives the predictor a memory."""
    low, high = -5.0, 3.0  # decades of their size, from one that moves a position by its noise in a sample
    covariance, unit = covariance / np.trace(covariance), 1 / np.linalg.norm(C @ E)
    for _ in range(40):
        force = unit * 10 ** (0.5 * (low + high)) * E
        P = scipy.linalg.solve_discrete_are(A.T, C.T, force @ force.T, covariance)
        K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + covariance)
        low, high = (
            (0.5 * (low + high), high) if _memory(A - K @ C, sample_time) > memory_s else (low, 0.5 * (low + high))
        )
    if abs(_memory(A - K @ C, sample_time) / memory_s - 1) > 0.1:
        raise UsageError(
            f"RecursiveFit: no gain gives the predictor a memory of {memory_s:g} s; the nearest is "
            f"{_memory(A - K @ C, sample_time):.3g} s",
            "memory_s",
        )
    return np.asarray(K)


def _solved(upper: Sequence[Sequence[float]], right: Sequence[float]) -> list[float]:
    """Return the solution of an upper triangular system with a diagonal of ones."""
    n, result = len(right), list(right)
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            result[i] = result[i] - upper[i][j] * result[j]
    return result
