"""Cancellation of unbalance while the rotor runs: tables, proof of convergence, and the step of a sample."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy

from gbid.control import ControllerDesign, GainResult, close_loop, exact_plant
from gbid.control.loop.close import force_entry, sample_plant
from gbid.control.loop.sampled import exact_plant_of
from gbid.control.loop.sensitivity import sensitivities
from gbid.control.tuning.plants import checked_models
from gbid.core.arrays import ComplexArray, FloatArray, Point, point_label
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Positive, Share, check_options
from gbid.identify import FitResult
from gbid.identify.uncertainty.uncertain_model import UncertainModel, as_uncertain
from gbid.lpv import Domain, LPVFit, LPVModel
from gbid.lpv.regression import covariance_root
from gbid.online.grid import GridTable, table_over_domain
from gbid.structure import LinearModel
from gbid.structure.scheduling import SCHEDULING

LARGEST_PHASE_DEG = 60.0
"""Largest phase error of the table against the loop with which the cancellation counts as convergent [degrees]."""
ENDS_AFTER_S = 0.5
"""Time at the limit of the feed-forward after which the watchdog ends the cancellation [s]."""
NEAR_LIMIT = 0.9
"""Square of the share of the limit above which the feed-forward counts as being at its limit."""
ModelOfLoop = LPVFit | LPVModel | FitResult | UncertainModel | LinearModel


@dataclass(frozen=True)
class UnbalanceEstimate(Brief):
    """Unbalance of a rotor, for a balance weight on the opposite side.

    Attributes
    ----------
    g_mm, g_mm_std : float
        Unbalance and its standard deviation [g mm].
    angle_deg, angle_deg_std : float
        Angle on the shaft, from the zero of the encoder in the direction of rotation [degrees].
    """

    g_mm: float
    g_mm_std: float
    angle_deg: float
    angle_deg_std: float


@dataclass(frozen=True, eq=False)
class BalanceWhileRunning(Brief):
    r"""Feed-forward that cancels the once-per-turn motion of a controlled rotor.

    .. math:: r_k = K e_k + \mathrm{Re}(c_k e^{j\varphi_k}), \qquad
              c_{k+1} = c_k - \mu\, T(j\Omega)^{-1} e_k e^{-j\varphi_k}, \qquad T = (I - G K)^{-1} G

    T is the sampled loop of the identified plant from the references to the position, with the computation time. Its
    inverse is tabulated over speed and pressure. The mean of c follows :math:`\tau \dot c = -T^{-1}(T c + d)` with the
    time constant :math:`\tau = 2 T_s / \mu`, so that the once-per-turn motion decays where the phase of the table is
    right within less than 90 degrees.

    Parameters
    ----------
    model : LPVFit, LPVModel, FitResult, UncertainModel or LinearModel
        Plant from the references to the position. Surfaces are evaluated at each speed; a model at one point holds for
        all speeds. An `LPVFit`, a `FitResult` and an `UncertainModel` have the uncertainty of the plant.
    controller : ControllerDesign or GainResult
        The controller, with its sample time.
    speeds_rpm : (float, float), optional
        Speeds between which unbalance is cancelled [rpm]; by default the upper three quarters of the domain of the
        surfaces. A model at one point needs them.
    time_constant_s : float
        tau [s]. The once-per-turn motion falls to a tenth within 2.3 of it.
    share : float
        Limit of the feed-forward of each output, as a share of the limit of the output.
    level : float
        Probability of the region of plants for which the cancellation must converge.
    moving_mass_kg : float, optional
        Mass to which the plant refers [kg], for the unbalance in g mm; by default that of the surfaces.

    Attributes
    ----------
    table : GridTable
        Real, then imaginary parts of ``mu T^-1``, row by row, over pressure and speed.
    points : (n, 2) array
        Nodes of the table and middles between them: pressure [bar], speed [rpm].
    phase_error_deg : (n,) array
        Bound of the phase error at these points [degrees]: interpolation, and all plants within the region of
        probability `level`, to first order in the parameters.
    has_uncertainty : bool
        Whether the model states an uncertainty. Without it the phase error is that of the interpolation alone.

    Raises
    ------
    UsageError
        When the phase error may exceed 60 degrees (the message names the speeds), when the sampled loop with a phase
        error of up to 60 degrees is unstable because the time constant is too short, or when the channels of model and
        controller do not fit.

    Notes
    -----
    The disturbance at once per turn is cancelled at the sensor. Run-out that is left in the position is taken for
    motion, so that the run-out map must be recorded at slow roll. With :math:`q_k = c_k e^{j\varphi_k}` the
    cancellation at constant speed is linear and time-invariant, which gives the exact test of stability.

    Examples
    --------
    >>> import gbid
    >>> plant = gbid.control.exact_plant(gbid.load_model("theisen2016"), 6.0, 6000.0)
    >>> P, gains = gbid.controller_structure("P"), {"kappa_x": 1.1, "kappa_y": 1.0}
    >>> design = gbid.control.ControllerDesign("damper", P, gains, sample_time=2e-4)
    >>> balance = gbid.BalanceWhileRunning(plant, design, speeds_rpm=(4000, 7400))
    >>> bool(balance.phase_error_deg.max() < 1)
    True
    """

    model: ModelOfLoop
    controller: ControllerDesign | GainResult
    speeds_rpm: tuple[Positive, Positive] | None = None
    time_constant_s: Positive = 0.1
    share: Share = 0.5
    level: Share = 0.95
    moving_mass_kg: Positive | None = None
    table: GridTable = field(init=False)
    points: FloatArray = field(init=False)
    phase_error_deg: FloatArray = field(init=False)
    has_uncertainty: bool = field(init=False)

    def __post_init__(self) -> None:
        check_options(self, "BalanceWhileRunning")
        surfaces = self.model.model if isinstance(self.model, LPVFit) else self.model
        pressures, speeds = (0.0, 0.0), self.speeds_rpm
        if isinstance(surfaces, LPVModel):
            if surfaces.domain.variables != SCHEDULING:
                raise UsageError(
                    f"BalanceWhileRunning: model {surfaces.name!r} is scheduled over "
                    f"{', '.join(surfaces.domain.variables)}; give one over {' and '.join(SCHEDULING)}",
                    "model",
                )
            (low, top), pressures = surfaces.domain.speed_rpm, surfaces.domain.pressure_bar
            speeds = speeds or (max(0.25 * top, low), top)
            self._set(moving_mass_kg=self.moving_mass_kg or surfaces.machine.moving_mass_kg)
        if speeds is None or not speeds[0] < speeds[1]:
            raise UsageError(
                f"BalanceWhileRunning: speeds_rpm = {speeds}; give the lowest and the highest speed at which unbalance "
                "is to be cancelled, such as (4000, 7400); on the command line --speeds 4000 7400",
                "speeds_rpm",
            )
        self._set(speeds_rpm=speeds)
        loops: dict[Point, tuple[LinearModel, LinearModel]] = {}

        def row_at(pressure: float, speed: float) -> FloatArray:
            held, law, T = self._loop(pressure, speed)
            loops[pressure, speed] = held, law
            W = 2 * self.design.rate / self.time_constant_s * np.linalg.pinv(T)
            return np.concatenate([W.real.ravel(), W.imag.ravel()])

        self._set(table=table_over_domain(row_at, Domain(pressures, speeds)))
        nodes = [p for p in self.table.axes["pressure_bar"] if p <= pressures[1]], self.table.axes["speed_rpm"]
        points = np.array([(p, s) for p in _with_middles(nodes[0]) for s in _with_middles(nodes[1])])
        self._set(points=points, has_uncertainty=bool(self._plants(*points[0])[1]))
        phases = np.array([self._phase_error(*point) for point in points.tolist()])
        self._set(phase_error_deg=phases)
        worst = phases > LARGEST_PHASE_DEG
        if worst.any():
            raise UsageError(
                f"BalanceWhileRunning: the phase error may exceed {LARGEST_PHASE_DEG:g} degrees at "
                f"{_named(points[worst])} (up to {phases.max():.0f}); leave these speeds out (speeds_rpm), or identify "
                "the plant more precisely",
                "speeds_rpm",
            )
        unstable = [point for point, loop in sorted(loops.items()) if not self._is_stable(point, *loop)]
        if unstable:
            raise UsageError(
                f"BalanceWhileRunning: time_constant_s = {self.time_constant_s:g} s is too short for the loop at "
                f"{_named(np.array(unstable))}; give a longer one",
                "time_constant_s",
            )

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @cached_property
    def design(self) -> ControllerDesign:
        """The controller with its sample time."""
        return self.controller.design() if isinstance(self.controller, GainResult) else self.controller

    def _brief(self) -> Description:
        return brief(
            self,
            self.design.name,
            speeds_rpm=self.speeds_rpm,
            time_constant_s=self.time_constant_s,
            phase_error_deg=self.phase_error_deg,
            has_uncertainty=self.has_uncertainty,
        )

    def weights(self, pressure_bar: float, speed_rpm: float) -> ComplexArray:
        """Return ``mu T^-1`` from the table, (n_outputs, n_inputs) of the controller.

        Parameters
        ----------
        pressure_bar, speed_rpm : float
            Operating point [bar], [rpm].
        """
        real, imaginary = np.split(np.array(self.table.row(pressure_bar, speed_rpm)), 2)
        law = self.design.sampled_at(pressure_bar, speed_rpm)
        return np.asarray((real + 1j * imaginary).reshape(law.D.shape))

    def _plants(self, pressure: float, speed: float) -> tuple[LinearModel, list[LinearModel]]:
        """Return the plant at a point, and plants that differ by one standard deviation along each direction."""
        model, moved = self.model, []
        if isinstance(model, LPVFit | LPVModel):
            lpv = model.model if isinstance(model, LPVFit) else model
            plant = exact_plant(lpv, pressure, speed)
            if isinstance(model, LPVFit):
                values = dict(lpv.key_parameters(pressure, speed))
                names = model.estimates.parameters
                for step in covariance_root(model.uncertainty_at(pressure, speed, scatter=True)).T:
                    changed = {name: values[name] + change for name, change in zip(names, step, strict=True)}
                    moved.append(exact_plant_of(lpv, {**values, **changed}))
        else:
            uncertain = as_uncertain(model)
            slopes, covariance = uncertain.known()
            plant = uncertain.model
            for step in np.zeros((0, 0)) if covariance is None else covariance_root(covariance).T:
                letters = "ABCD" if plant.delay is None else ("A", "B", "C", "D", "B_delayed", "delay")
                moved.append(
                    replace(
                        plant, **{a: getattr(plant, a) + np.tensordot(step, getattr(slopes, a), 1) for a in letters}
                    )
                )
        law = self.design.sampled_at(pressure, speed)
        channels: Any = SimpleNamespace(name=law.name, inputs=law.input_names, outputs=law.output_names)
        named = set(law.input_names) <= set(plant.output_names) and set(law.output_names) <= set(plant.input_names)
        chosen = (law.output_names, law.input_names) if named else (None, None)
        plant, *moved = checked_models([plant, *moved], channels, *chosen)
        return plant, moved

    def _loop(self, pressure: float, speed: float) -> tuple[LinearModel, LinearModel, ComplexArray]:
        """Return the sampled plant, the sampled controller, and T at once per turn."""
        rate = self.design.rate
        held, law = sample_plant(self._plants(pressure, speed)[0], rate, rate), self.design.sampled_at(pressure, speed)
        loop = sensitivities(held, law)
        if not loop.is_stable():
            raise UsageError(
                f"BalanceWhileRunning: the sampled loop of controller {self.design.name!r} is unstable at "
                f"{point_label(pressure, speed)}"
            )
        return held, law, loop.response("plant", speed / 60)[0]

    def _responses(self, pressure: float, speed: float) -> Iterator[tuple[LinearModel, ComplexArray]]:
        """Yield the plant and its sampled response G at once per turn, then those one standard deviation off."""
        plant, moved = self._plants(pressure, speed)
        hz, rate = speed / 60, self.design.rate
        held = sample_plant(plant, rate, rate).frequency_response(hz)[0]
        delay = np.sinc(hz * rate) * np.exp(-3j * np.pi * hz * rate)  # half a sample of hold, one of computation
        continuous = plant.frequency_response(hz)[0]
        yield plant, held
        for each in moved:
            yield each, held + delay * (each.frequency_response(hz)[0] - continuous)

    def _phase_error(self, pressure: float, speed: float) -> float:
        """Return a bound of the phase error at a point [degrees]; 90 where no bound below 90 is found.

        With ``W T = I + E`` the field of values of W T lies within the angle ``asin |E|`` of the real axis.
        """
        K = self.design.sampled_at(pressure, speed).frequency_response(speed / 60)[0]
        W = self.weights(pressure, speed) * self.time_constant_s / (2 * self.design.rate)
        T, *moved = (np.linalg.solve(np.eye(len(G)) - G @ K, G) for _, G in self._responses(pressure, speed))
        error = float(np.linalg.norm(W @ T - np.eye(len(W)), 2))
        if moved:
            slopes = np.array([(W @ (each - T)).ravel() for each in moved])
            parts = np.hstack([slopes.real, slopes.imag])
            error += float(np.sqrt(scipy.stats.chi2.ppf(self.level, len(moved))) * np.linalg.norm(parts, 2))
        return float(np.degrees(np.arcsin(min(error, 1.0))))

    def _is_stable(self, point: Point, held: LinearModel, law: LinearModel) -> bool:
        """Return whether the sampled loop with the cancellation is stable for phase errors of up to 60 degrees."""
        closed, turn = close_loop(held, law), 2j * np.pi * point[1] / 60 * self.design.rate
        W = self.weights(*point)
        n = len(W)
        for phase in np.radians([-LARGEST_PHASE_DEG, 0.0, LARGEST_PHASE_DEG]):
            turned = np.exp(turn + 1j * phase) * W
            into = np.vstack([turned.real, turned.imag])
            rotation = np.kron(
                [[np.cos(turn.imag), -np.sin(turn.imag)], [np.sin(turn.imag), np.cos(turn.imag)]], np.eye(n)
            )
            forward = np.eye(n, 2 * n)  # the feed-forward is the real part of q
            whole = np.block([[closed.A, closed.B @ forward], [-into @ closed.C, rotation - into @ closed.D @ forward]])
            if np.abs(np.linalg.eigvals(whole)).max() >= 1:
                return False
        return True

    def unbalance(
        self,
        feedforward: npt.ArrayLike,
        residual: npt.ArrayLike,
        *,
        pressure_bar: float,
        speed_rpm: float,
        residual_std: float = 0.0,
    ) -> UnbalanceEstimate:
        r"""Return the unbalance that explains the feed-forward and the once-per-turn motion that is left.

        .. math:: F = H^{-1}\bigl(P - G (K P + c)\bigr), \qquad F = a\, \Omega^2 e^{j\alpha} [1, -j]^T

        H is the response of the position to a force per mass, and a the unbalance per mass.

        Parameters
        ----------
        feedforward : (2,) complex array
            c, the output `balance` of the chain, better its mean over some turns [m].
        residual : (2,) complex array
            P, the output `once_per_turn` of the chain [m].
        pressure_bar, speed_rpm : float
            Operating point [bar], [rpm].
        residual_std : float
            Standard deviation of real and imaginary parts of P by noise [m].

        Returns
        -------
        UnbalanceEstimate
            Its standard deviations contain the uncertainty of the model, to first order, and `residual_std`.

        Raises
        ------
        UsageError
            When the moving mass is not known, or when the machine has no two axes with forces.
        """
        c, P = np.asarray(feedforward, complex), np.asarray(residual, complex)
        if self.moving_mass_kg is None or c.shape != (2,) or P.shape != (2,):
            raise UsageError(
                f"unbalance: feedforward of shape {c.shape}, residual of shape {P.shape}, moving_mass_kg = "
                f"{self.moving_mass_kg}; give two axes each, and the moving mass to BalanceWhileRunning",
                "moving_mass_kg",
            )
        K = self.design.sampled_at(pressure_bar, speed_rpm).frequency_response(speed_rpm / 60)[0]
        factor = 0.5e6 * self.moving_mass_kg / (speed_rpm * np.pi / 30) ** 2
        values, noise = [], np.zeros(2)
        for plant, G in self._responses(pressure_bar, speed_rpm):
            forced = replace(plant, B=force_entry(plant), D=0 * plant.D, B_delayed=None, delay=None)
            inverse = np.linalg.inv(forced.frequency_response(speed_rpm / 60)[0])
            values.append(factor * np.array([1, 1j]) @ inverse @ (P - G @ (K @ P + c)))
            if len(values) == 1:
                noise = np.abs(factor * np.array([1, 1j]) @ inverse @ (np.eye(2) - G @ K)) * residual_std
        value = values[0]
        steps = (np.array(values[1:]) - value) * np.exp(-1j * np.angle(value))
        radial, tangential = (
            np.hypot(np.linalg.norm(part), np.linalg.norm(noise)) for part in (steps.real, steps.imag)
        )
        angle = np.degrees(tangential / max(abs(value), 1e-300))
        return UnbalanceEstimate(
            float(abs(value)), float(radial), float(np.degrees(np.angle(value)) % 360), float(min(angle, 180.0))
        )


def _with_middles(nodes: Sequence[float]) -> list[float]:
    return sorted({*nodes, *(0.5 * (a + b) for a, b in pairwise(nodes))})


def _named(points: FloatArray) -> str:
    """Return operating points as text; pressures only where there are several."""
    several = len(set(points[:, 0])) > 1
    return ", ".join(point_label(*point) if several else f"{point[1]:g} rpm" for point in points.tolist())


class Balancing:
    """Cancellation of unbalance sample by sample: the reference of the generated source, with its order of operations.

    Parameters
    ----------
    balance : BalanceWhileRunning
        Tables and speeds.
    limits : sequence of float
        Limits of the outputs of the controller.
    fade_samples : int
        Samples in which the feed-forward is faded in and out.
    """

    def __init__(self, balance: BalanceWhileRunning, limits: Sequence[float], fade_samples: int) -> None:
        self._balance, self._n_in = balance, balance.table.rows.shape[1] // (2 * len(limits))
        self._fade_samples = fade_samples
        self.squares = [(balance.share * limit) * (balance.share * limit) for limit in limits]
        self.end_samples = max(1, round(ENDS_AFTER_S / balance.design.rate))
        self.share = balance.design.rate / balance.time_constant_s
        self.c = [[0.0, 0.0] for _ in limits]
        self.once = [[0.0, 0.0] for _ in range(self._n_in)]
        self.level, self.full, self.ended, self.in_range = 0, 0, False, False
        self._turn, self._active = (1.0, 0.0), False

    def forward(
        self, turn: tuple[float, float] | None, speed: float, control_is_on: bool, in_control: bool
    ) -> list[float]:
        """Return the feed-forward of a sample, and advance its fade.

        Parameters
        ----------
        turn : (float, float) or None
            Cosine and sine of the shaft angle; None for a faulty sample, at which they are held.
        speed : float
            Speed of the shaft [rpm].
        control_is_on : bool
            Whether the controller is faded in.
        in_control : bool
            Whether the mode is CONTROL; another mode ends the memory of the watchdog.
        """
        low, high = cast(tuple[float, float], self._balance.speeds_rpm)
        if turn is not None:
            self._turn, self.in_range = turn, low <= speed <= high
        self.ended, self.full = self.ended and in_control, self.full if in_control else 0
        self._active = control_is_on and self.in_range and not self.ended
        self.level = min(self.level + 1, self._fade_samples) if self._active else max(self.level - 1, 0)
        if self.level == 0:
            self.c = [[0.0, 0.0] for _ in self.c]
        scale, (cosine, sine) = self.level * (1.0 / self._fade_samples), self._turn
        return [scale * (real * cosine - imaginary * sine) for real, imaginary in self.c]

    def adapt(self, deviation: Sequence[float], point: Sequence[float], saturated: bool) -> None:
        """Move c by a good sample; a sample at the limit of the references counts for the watchdog only.

        Parameters
        ----------
        deviation : sequence of float
            e of the sample.
        point : (float, float)
            Pressure and speed of the schedules.
        saturated : bool
            Whether a reference is at its limit.
        """
        cosine, sine = self._turn
        for once, e in zip(self.once, deviation, strict=True):
            once[0] = once[0] + self.share * (2.0 * e * cosine - once[0])
            once[1] = once[1] - self.share * (2.0 * e * sine + once[1])
        if not self._active:
            return
        row, n, m = self._balance.table.row(*point), self._n_in, len(self.c)
        near = saturated
        for i, (c, square) in enumerate(zip(self.c, self.squares, strict=True)):
            a, b = row[i * n] * deviation[0], row[(m + i) * n] * deviation[0]
            for j in range(1, n):
                a, b = a + row[i * n + j] * deviation[j], b + row[(m + i) * n + j] * deviation[j]
            real, imaginary = c[0] - (a * cosine + b * sine), c[1] - (b * cosine - a * sine)
            near = near or c[0] * c[0] + c[1] * c[1] > NEAR_LIMIT * square
            if not saturated and real * real + imaginary * imaginary <= square:
                c[0], c[1] = real, imaginary
        self.full = min(self.full + 1, self.end_samples) if near else 0
        self.ended = self.ended or self.full >= self.end_samples
