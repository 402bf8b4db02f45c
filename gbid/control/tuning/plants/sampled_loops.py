"""Sampled loops of an LPV plant at operating points: zero-order hold and delays exact, a controller with its rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gbid.arrays import FloatArray
from gbid.control.loop.sampling import Method, sample_plant
from gbid.control.tuning.plants.controller_law import ControllerLaw
from gbid.control.tuning.plants.loops_at_points import LoopsAtPoints
from gbid.control.tuning.plants.model_family import PlantMatrices, model_family
from gbid.control.tuning.plants.plant_set import PlantSet, corners
from gbid.control.tuning.search.loop_family import LoopFamily
from gbid.errors import UsageError
from gbid.lpv import LPVModel
from gbid.operating_point import point_label
from gbid.structure import KEY_PARAMETERS, LinearModel, PiezoPair, Plant, RotorBearing, evaluate


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
class SampledLoops(PlantSet):
    """Sampled loops of an LPV plant and one controller structure, with all drawn plants.

    Parameters
    ----------
    continuous : LoopsAtPoints
        The same loops in continuous time.
    lpv : LPVModel
        The plant with its actuators.
    sampling : Sampling
        Rate, computation time and method of the target.
    """

    continuous: LoopsAtPoints
    lpv: LPVModel
    sampling: Sampling
    _known: dict[tuple[float, ...], LinearModel] = field(default_factory=dict, init=False, repr=False)

    @property
    def structure(self) -> object:
        """Structure of the controller."""
        return self.continuous.structure

    def family(self, points: FloatArray, which: Sequence[int] | None = None) -> LoopFamily:
        """Return the loops at given points, or some of them."""
        scenarios, labels = self.continuous.scenarios(points)
        chosen = list(range(len(scenarios)) if which is None else which)
        plants = stacked([self._sampled(scenarios[i]) for i in chosen])
        where = np.ascontiguousarray(scenarios[chosen, :2])
        T, method = self.sampling.sample_time, self.sampling.method
        law = ControllerLaw(self.continuous.structure, where, (2, 2), T, method)
        names = tuple(labels[i] for i in chosen)
        return model_family(plants, law, names, where, self.continuous.equations.family(scenarios[chosen], names))

    def first(self, points: FloatArray) -> list[int]:
        """Return the points nearest to the corners of the operating range."""
        return corners(points)

    def _sampled(self, scenario: FloatArray) -> LinearModel:
        key = tuple(float(v) for v in scenario)
        if key not in self._known:
            self._known[key] = self._sample(scenario)
        return self._known[key]

    def _sample(self, scenario: FloatArray) -> LinearModel:
        values = dict(self.lpv.key_parameters(float(scenario[0]), float(scenario[1])))
        for name, change in zip(KEY_PARAMETERS, scenario[2:], strict=False):
            values[name] += change
        late = [name for name in ("tau_x", "tau_y") if values[name] <= 0]
        if late:
            raise UsageError(
                f"model {self.lpv.name!r}: a drawn plant has {late[0]} = {values[late[0]]:g} s; fix the delays"
            )
        structure = Plant(RotorBearing(delay="exact", disturbance_gain="none"), PiezoPair(), outputs=("p",))
        try:
            exact = evaluate(structure, {**self.lpv.actuators, **values}, ("r_x", "r_y"), ("p_x", "p_y"))
            return sample_plant(exact, self.sampling.sample_time, self.sampling.computation_s)
        except UsageError as error:
            where = point_label(float(scenario[0]), float(scenario[1]))
            raise UsageError(
                f"model {self.lpv.name!r} at {where}, or a plant drawn around it, cannot be sampled: {error}"
            ) from None


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
