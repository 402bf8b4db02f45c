"""Sampled loop: a sampled controller with computation time, and a plant with exact delays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from gbid.control.loop.close import Method, close_loop, sample_controller, sample_plant, smallest_damping
from gbid.control.loop.norm import Peak
from gbid.control.loop.sensitivity import Sensitivities, sensitivities
from gbid.core.brief import Brief
from gbid.lpv import LPVModel
from gbid.structure import LinearModel
from gbid.structure.linear import evaluate


@dataclass(frozen=True, eq=False)
class SampledLoop(Brief):
    """Sampled loop, from samples of p to held references r.

    Attributes
    ----------
    plant : LinearModel
        Sampled plant, with delays and computation time.
    controller : LinearModel
        Sampled controller.
    closed : LinearModel
        S_o G of the two.
    damping : float
        Smallest damping factor of the oscillatory modes that last longer than a sample, see
        `gbid.control.smallest_damping`; negative when the loop is unstable.
    modes : tuple of (frequency_hz, damping)
        All oscillatory modes, from ``log(eigenvalue) / T_s``, by rising frequency.
    stable : bool
        Whether the loop is stable.
    peak_output : Peak
        Largest singular value of S_o for samples of p, up to half the sampling frequency.
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


def exact_plant(lpv: LPVModel, *point: float) -> LinearModel:
    """Return the plant from r to p at one operating point, with exact delays.

    Parameters
    ----------
    lpv : LPVModel
        Model with actuators.
    *point : float
        Scheduling variables; of a gas bearing pressure [bar] and speed [rpm].

    Returns
    -------
    LinearModel
        Continuous plant, equal to `LPVModel.plant_at` but for the delays. Frequency responses, `sample_plant` and
        `gbid.structure.with_pade` accept it.

    Raises
    ------
    UsageError
        As for `LPVModel.plant_at`.
    """
    name = lpv.plant_at(*point).name  # raises the errors of plant_at
    return replace(exact_plant_of(lpv, lpv.key_parameters(*map(float, point))), name=f"{name}, exact delays")


def exact_plant_of(lpv: LPVModel, values: Mapping[str, float]) -> LinearModel:
    """Plant of a model with exact delays, from the values of the parameters at a point."""
    structure = lpv.plant_structure(None)
    return evaluate(structure, {**lpv.actuators, **values}, *lpv.channels(structure))


def sampled_loop(
    plant: LinearModel,
    controller: LinearModel,
    sample_time: float = 2e-4,
    *,
    computation_s: float | None = None,
    method: Method = "tustin",
) -> SampledLoop:
    """Return the sampled loop of a plant with exact delays, as a real-time target runs it.

    Parameters
    ----------
    plant : LinearModel
        Continuous plant; with exact delays for the true loop, see `exact_plant`.
    controller : LinearModel
        Continuous controller, or sampled with the same sample time.
    sample_time : float
        T_s [s]; 0.2 ms in the paper.
    computation_s : float, optional
        Time from the sample of p to the change of r [s]; one sample when not given.
    method : {"tustin", "zoh"}
        Method of discretisation of a continuous controller, see `sample_controller`.

    Returns
    -------
    SampledLoop

    Raises
    ------
    UsageError
        As for `sample_plant`, `sample_controller` and `gbid.close_loop`.
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
