"""Structure of a closed loop: a plant with unknown parameters and a controller, continuous or sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from gbid.core.brief import Brief
from gbid.core.errors import UsageError
from gbid.core.option_types import CountOrZero, checks_arguments
from gbid.discretise import Hold
from gbid.structure.built_in import Plant, RotorBearing
from gbid.structure.delay import pade_matrices, with_pade
from gbid.structure.kinds import LinearKind, equations_of, kind_of
from gbid.structure.linear import (
    ControlLaw,
    HeldFeedback,
    LoopParts,
    Matrices,
    Structure,
    as_names,
    closed_parts,
    symbolic_matrices,
)
from gbid.structure.models import LinearModel
from gbid.structure.parameter import Parameter, Values, set_fields


def law_of(controller: LinearModel | Structure, gains: ca.SX, pade_order: int) -> ControlLaw:
    """Return the state-space matrices of a controller.

    Parameters
    ----------
    controller : LinearModel or Structure
        The controller; exact delays of a model become Padé filters.
    gains : casadi.SX
        Symbols of the gains of a structure, in its order.
    pade_order : int
        Order of these filters.

    Raises
    ------
    UsageError
        When a structure has exact delays.
    """
    if isinstance(controller, LinearModel):
        model = with_pade(controller, pade_order)
        return ControlLaw(*(ca.SX(ca.sparsify(ca.DM(getattr(model, letter)))) for letter in "ABCD"))
    p, m = symbolic_matrices(controller)
    if m.has_delay:
        raise UsageError(f"controller {controller.name!r} has exact delays; give pade_delay filters instead")
    return ControlLaw(*ca.substitute([m.A, m.B, m.C, m.D], [p], [gains]))


def tustin(law: ControlLaw, sample_time: float) -> ControlLaw:
    """Return a controller sampled by the trapezoidal rule, as a control program runs it.

    With ``M = (I - h A / 2)^-1`` the matrices are ``2 M - I``, ``h M B``, ``C M`` and ``D + h C M B / 2``.
    """
    n, h = law.A.shape[0], sample_time
    if not n:
        return law
    M = ca.sparsify(ca.inv(ca.SX.eye(n) - h / 2 * law.A))
    return ControlLaw(2 * M - ca.SX.eye(n), h * M @ law.B, law.C @ M, law.D + h / 2 * law.C @ M @ law.B)


def computed_later(law: ControlLaw, samples: int) -> ControlLaw:
    """Return a sampled controller with a delay of some samples; each sample adds a state for each output."""
    for _ in range(samples):
        n, n_r = law.A.shape[0], law.C.shape[0]
        law = ControlLaw(
            ca.blockcat([[law.A, ca.SX(n, n_r)], [law.C, ca.SX(n_r, n_r)]]),
            ca.vertcat(law.B, law.D),
            ca.horzcat(ca.SX(n_r, n), ca.SX.eye(n_r)),
            ca.SX(n_r, law.D.shape[1]),
        )
    return law


PREFIX = "controller_"
"""What precedes the gains of a controller in the names of the parameters of a loop."""

_SLOWEST = 40.0  # [1/s] a state falls to 2 % in a tenth of a second

Injection = Literal["plant input", "set point"]


@dataclass(frozen=True, init=False)
class ClosedLoop(Brief):
    """Closed loop of a structure and a controller: from the injected signals to the recorded ones.

    A loop is a structure like any other: `gbid.fit` estimates the parameters of the plant from recordings that were
    made in closed loop. With ``focus="prediction"`` the predictor knows that the controller reacts to measured noise
    as well (direct method). With ``focus="simulation"`` the outputs are simulated from the injected signal alone
    (indirect method): feedback gives the estimates no bias, whatever the noise is.

    Parameters
    ----------
    structure : Structure
        Plant, from the output of the controller to the recorded outputs. Exact delays become Padé filters, or states
        that hold the last inputs; see `pade_order`.
    controller : LinearModel or Structure
        Controller from measured outputs to the inputs of the plant, which add up as ``r = w + K y``: positive gains
        are positive feedback. A continuous model or structure makes a continuous loop, with exact delays of the model
        as Padé filters. A sampled model (`dt`), or a structure with `sample_time`, makes the loop as it runs on a
        target: the output is held between samples and acts after the computation time. The parameters of a structure
        are estimated along, under the names ``controller_<gain>``; fix those that are known.
    sample_time : float, optional
        Samples a continuous controller by the trapezoidal rule (Tustin) [s].
    computation_samples : int
        Samples from the measurement to the action of a sampled controller. One by default: the target computes for
        one sample.
    measured : sequence of int, optional
        Positions of the outputs (channels) that the controller measures. By default the last ones, which is p of a
        `Plant` with the outputs u and p.
    injected : {"plant input", "set point"}
        Where the excitation w enters. "plant input": it is added to the output of the controller. "set point": the
        controller gets ``y - w``.
    inputs, outputs : str or sequence of str, optional
        Signals of the recordings: what is injected, ``"w"`` by default, and by default the outputs of the structure.
    pade_order : int, optional
        Order of the Padé filters. With None the delays of the plant stay exact. That needs a sampled controller, and an
        upper bound of each delay: the inputs of as many samples are states.
    name : str
        Name of the loop; by default that of the plant and of the controller.

    Raises
    ------
    UsageError
        When the sizes of plant and controller do not fit, when both have direct feedthrough, when options of a sampled
        controller are given for a continuous one, or when exact delays have no upper bound.

    Notes
    -----
    Prediction errors of the loop with its known controller are those of the plant, driven by what the controller did
    (Ljung, System Identification, 2nd ed., Sec. 13.4 and 13.5). The two focuses are the direct and the indirect method
    of that chapter. The direct method is the more precise one, and needs a sufficient disturbance gain.
    """

    structure: Structure
    controller: LinearModel | Structure
    sample_time: float | None
    computation_samples: int
    measured: tuple[int, ...]
    injected: Injection
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    pade_order: int | None
    name: str
    intersample: Hold

    @checks_arguments
    def __init__(
        self,
        structure: Structure,
        controller: LinearModel | Structure,
        *,
        sample_time: float | None = None,
        computation_samples: CountOrZero = 1,
        measured: Sequence[int] | None = None,
        injected: Injection = "plant input",
        inputs: str | Sequence[str] = "w",
        outputs: str | Sequence[str] | None = None,
        pade_order: int | None = 3,
        name: str = "",
    ) -> None:
        where = f"loop of {structure.name!r} and {controller.name!r}"
        rate = controller.dt if isinstance(controller, LinearModel) else None
        if rate is not None and sample_time is not None and not np.isclose(rate, sample_time, rtol=1e-9):
            raise UsageError(f"{where}: sample_time = {sample_time:g} s, but the controller has {rate:g} s")
        if kind_of(equations_of(structure)).nonlinear:
            raise UsageError(f"{where}: the plant must be linear")
        _, m = symbolic_matrices(structure)
        if m.feedback is not None:
            raise UsageError(f"{where}: the structure is a sampled loop itself; give its plant")
        n_y, n_s, n_r = m.C.shape[0], *_size(controller)
        rows = tuple(range(n_y - n_s, n_y) if measured is None else measured)
        if n_r != m.B.shape[1] or len(rows) != n_s or not all(0 <= row < n_y for row in rows):
            raise UsageError(
                f"{where}: the controller takes {n_s} signals and makes {n_r}, the structure takes {m.B.shape[1]} and "
                f"gives {n_y}; measured = {list(rows)}"
            )
        chosen = {
            "sample_time": sample_time if rate is None else rate,
            "measured": rows,
            "inputs": as_names(inputs),
            "outputs": as_names(structure.outputs if outputs is None else outputs),
            "name": name or f"{structure.name}, closed by {controller.name}",
            "intersample": "zoh",
        }
        set_fields(self, {**locals(), **chosen})
        late_law = isinstance(controller, LinearModel) and controller.delay is not None
        if pade_order is None and (late_law or (m.has_delay and self.sample_time is None)):
            raise UsageError(f"{where}: exact delays of the plant need a sampled controller")
        if not np.isfinite(self._longest_delay):
            raise UsageError(f"{where}: exact delays in a loop need upper bounds; give them, or pade_order")
        symbols = Values.of(self.parameters, ca.vertcat(*(ca.SX.sym(q.name) for q in self.parameters)))
        if m.D.nnz() and self._law(symbols).D.nnz():
            raise UsageError(
                f"{where}: both have direct feedthrough; give the controller a low-pass or a computation time"
            )

    @property
    def gains(self) -> tuple[Parameter, ...]:
        """Parameters of the controller, when it is a structure, under their names in the loop."""
        if isinstance(self.controller, LinearModel):
            return ()
        return tuple(replace(gain, name=PREFIX + gain.name) for gain in self.controller.parameters)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the plant, then the parameters of the controller."""
        return (*self.structure.parameters, *self.gains)

    @property
    def forgotten_states(self) -> tuple[int, ...]:
        """States that start at rest: of delays, of hidden actuators, and of a fast controller behind hidden actuators.

        They forget their start within milliseconds, so that noisy data do not tell it.
        """
        _, m = symbolic_matrices(self.structure)
        n_delayed = len(set(m.B_delayed.sparsity().get_triplet()[1])) if m.has_delay else 0
        n = m.n_states + (self._memory * m.B.shape[1] if self.pade_order is None else n_delayed * self.pade_order)
        of_plant = self.structure.forgotten_states if isinstance(self.structure, Plant | RotorBearing) else ()
        hidden = isinstance(self.structure, Plant) and "u" not in self.structure.outputs and not self.gains
        law = self.controller_model() if hidden else None
        unseen = range(n, n + law.n_states) if law is not None and _forgets(law) else ()
        return (*of_plant, *range(m.n_states, n), *unseen)

    def matrices(self, p: Values) -> dict[str, Any]:
        """Return the matrices of a continuous loop; for a sampled loop the plant, and the controller as "feedback"."""
        plant, law = self._plant(p), self._law(p)
        set_point = self.injected == "set point"
        drive, feed = plant.B, plant.D
        n, n_y = plant.A.shape[0], plant.C.shape[0]
        B, D = (ca.SX(n, len(self.measured)), ca.SX(n_y, len(self.measured))) if set_point else (drive, feed)
        law = law._replace(drive=drive, feed=feed, late=plant.B_delayed, delay=plant.delay)
        parts = LoopParts(plant.A, B, plant.C, D, plant.K)
        n_held = self._memory * drive.shape[1]
        begins = {"x0": ca.vertcat(plant.x0, ca.SX(n_held + law.A.shape[0], 1))} if plant.x0.numel() else {}
        if self.sample_time is None:
            return {**closed_parts(parts, law, self.measured, set_point)._asdict(), **begins}
        return {
            **parts._asdict(),
            "feedback": HeldFeedback(law, self.measured, set_point, self.sample_time, self._memory),
            **begins,
        }

    def controller_model(self, gains: Mapping[str, float] | None = None) -> LinearModel:
        """Return the controller as it runs: sampled, with computation time, and with Padé filters for delays.

        Parameters
        ----------
        gains : dict of str to float, optional
            Gains of a controller that is a structure, under their names in the loop.

        Raises
        ------
        UsageError
            When a gain is missing.
        """
        given = gains or {}
        missing = [gain.name for gain in self.gains if gain.name not in given]
        if missing:
            raise UsageError(f"{self.name}: no value for {', '.join(missing)}")
        law = self._law(Values({gain.name: ca.SX(float(given[gain.name])) for gain in self.gains}))
        A, B, C, D = (np.asarray(ca.DM(ca.densify(M)), float).reshape(M.shape) for M in law[:4])
        return LinearModel(A, B, C, D, dt=self.sample_time, name=self.controller.name)

    def _plant(self, p: Values) -> Matrices:
        symbols, m = symbolic_matrices(self.structure)
        values = ca.vertcat(*(p[q.name] for q in self.structure.parameters))
        A, B, C, D, K, B_delayed, delay, x0 = ca.substitute(list(m[:8]), [symbols], [values])
        m = Matrices(A, B, C, D, K, B_delayed, delay, x0)
        return m if self.pade_order is None else pade_matrices(m, self.pade_order)

    @property
    def _longest_delay(self) -> float:
        """Longest exact delay at the upper bounds of the parameters [s]; zero where delays are Padé filters."""
        p, m = symbolic_matrices(self.structure)
        if self.pade_order is not None or not m.has_delay:
            return 0.0
        bounds = np.array([q.start if q.fixed else q.upper for q in self.structure.parameters], float)
        return float(np.max(np.array(ca.Function("delay", [p], [ca.densify(m.delay)])(bounds))))

    @property
    def _memory(self) -> int:
        """Number of samples in the longest exact delay of a sampled loop, rounded up."""
        return 0 if self.sample_time is None else int(np.ceil(self._longest_delay / self.sample_time - 1e-9))

    def _law(self, p: Values) -> ControlLaw:
        law = law_of(self.controller, ca.vertcat(*(p[gain.name] for gain in self.gains)), self.pade_order or 1)
        if self.sample_time is None:
            return law
        if not (isinstance(self.controller, LinearModel) and self.controller.dt is not None):
            law = tustin(law, self.sample_time)
        return computed_later(law, self.computation_samples)


class LoopKind(LinearKind):
    """Answers of a closed loop to a fit; see `Kind`."""

    def __init__(self, structure: ClosedLoop) -> None:
        super().__init__(structure)
        self.plant = structure.structure
        self.states_at_rest = structure.forgotten_states


kind_of.register(ClosedLoop, LoopKind)


def _forgets(law: LinearModel) -> bool:
    """Return whether all poles decay to 2 % within a tenth of a second; false for an integrator."""
    poles = np.linalg.eigvals(law.A)
    rates = poles.real if law.dt is None else np.log(np.maximum(np.abs(poles), 1e-300)) / law.dt
    return bool(np.all(rates < -_SLOWEST))


def _size(controller: LinearModel | Structure) -> tuple[int, int]:
    """Return the numbers of inputs and outputs of a controller."""
    D = controller.D if isinstance(controller, LinearModel) else symbolic_matrices(controller)[1].D
    return int(D.shape[1]), int(D.shape[0])
