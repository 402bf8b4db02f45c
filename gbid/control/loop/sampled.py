"""The loop as it runs: a sampled controller, a computation that takes time, a plant with exact delays."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gbid.control.loop.close import close_loop
from gbid.control.loop.damping import smallest_damping
from gbid.control.loop.norm import Peak
from gbid.control.loop.sampling import Method, sample_controller, sample_plant
from gbid.control.loop.sensitivity import Sensitivities, sensitivities
from gbid.lpv import LPVModel
from gbid.structure import LinearModel, PiezoPair, Plant, RotorBearing, evaluate


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """A loop between samples of p and held references r.

    Attributes
    ----------
    plant : LinearModel
        Sampled, delays and computation in it.
    controller : LinearModel
        Sampled.
    closed : LinearModel
        S_o G of the two.
    damping : float
        Smallest damping factor of the oscillatory modes that last longer than a sample, see
        `gbid.control.smallest_damping`; negative when one grows.
    modes : tuple of (frequency_hz, damping)
        All of them, ``log(eigenvalue) / T_s``, by rising frequency.
    stable : bool
    peak_output : Peak
        Largest singular value of S_o between samples of p, up to half the sampling frequency.
    """

    plant: LinearModel
    controller: LinearModel
    closed: LinearModel
    damping: float
    modes: tuple[tuple[float, float], ...]
    stable: bool
    peak_output: Peak

    @property
    def sensitivities(self) -> Sensitivities:
        """Sensitivities of the sampled loop."""
        return sensitivities(self.plant, self.controller)


def exact_plant(lpv: LPVModel, pressure_bar: float, speed_rpm: float) -> LinearModel:
    """Whole plant from r to p at one operating point, its delays exact.

    Parameters
    ----------
    lpv : LPVModel
    pressure_bar, speed_rpm : float

    Returns
    -------
    LinearModel
        Continuous, as `LPVModel.plant_at` but for the delays; frequency responses, `sample_plant` and
        `gbid.with_pade` take it.

    Raises
    ------
    UsageError
        As `LPVModel.plant_at`.
    """
    name = lpv.plant_at(pressure_bar, speed_rpm).name  # refuses what it refuses
    values = {**lpv.actuators, **lpv.key_parameters(float(pressure_bar), float(speed_rpm))}
    structure = Plant(RotorBearing(delay="exact", disturbance_gain="none"), PiezoPair(), outputs=("p",))
    return replace(evaluate(structure, values, ("r_x", "r_y"), ("p_x", "p_y")), name=f"{name}, exact delays")


def sampled_loop(
    plant: LinearModel,
    controller: LinearModel,
    sample_time: float = 2e-4,
    *,
    computation_s: float | None = None,
    method: Method = "tustin",
) -> SampledLoop:
    """Close the loop as it runs on a real-time target.

    Parameters
    ----------
    plant : LinearModel
        Continuous; with exact delays for the true loop, see `exact_plant`.
    controller : LinearModel
        Continuous, or sampled at the same time.
    sample_time : float
        T_s [s]; 0.2 ms in the paper.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    method : {"tustin", "zoh"}
        How a continuous controller is sampled, see `sample_controller`.

    Returns
    -------
    SampledLoop

    Raises
    ------
    UsageError
        As `sample_plant`, `sample_controller` and `gbid.close_loop`.
    """
    discrete = controller if controller.dt is not None else sample_controller(controller, sample_time, method)
    held = sample_plant(plant, sample_time, sample_time if computation_s is None else computation_s)
    closed = close_loop(held, discrete)
    return SampledLoop(
        held,
        discrete,
        closed,
        smallest_damping(closed),
        tuple(closed.modes()),
        closed.is_stable(),
        sensitivities(held, discrete).peak("output"),
    )
