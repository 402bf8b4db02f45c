"""Conversion of linear models to objects of other libraries, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from gbid.errors import UsageError
from gbid.extras import extra_package
from gbid.structure.numeric.state_space import StateSpace


def scipy_state_space(model: StateSpace) -> Any:
    """Return the model as ``scipy.signal.StateSpace``; see `LinearModel.to_scipy`."""
    from scipy import signal

    _refuse_delays(model, "scipy")
    matrices = (np.array(m) for m in (model.A, model.B, model.C, model.D))
    return signal.StateSpace(*matrices, **({} if model.dt is None else {"dt": model.dt}))


def control_state_space(model: StateSpace) -> Any:
    """Return the model as ``control.StateSpace``; see `LinearModel.to_control`."""
    control = extra_package("control", "control", f"model {model.name!r}: conversion to python-control")
    _refuse_delays(model, "python-control")
    return control.StateSpace(
        *(np.array(m) for m in (model.A, model.B, model.C, model.D)),
        0 if model.dt is None else model.dt,
        inputs=_labels(model.input_names),
        outputs=_labels(model.output_names),
        states=_labels(model.state_names),
        name=model.name,
        remove_useless_states=False,
    )


def from_state_space(system: Any, name: str | None) -> dict[str, Any]:
    """Return the fields of a `LinearModel` given by a state-space system; see `LinearModel.from_control`."""
    if not all(hasattr(system, part) for part in ("A", "B", "C", "D", "dt", "input_labels")):
        raise UsageError(
            f"a {type(system).__name__} is not a state-space system of python-control; "
            "convert it first, control.ss(system)"
        )
    if system.dt is None or isinstance(system.dt, bool):
        raise UsageError(
            f"system {system.name!r} has dt = {system.dt}, which is not a sample time; "
            "set system.dt to 0 for continuous time, or to the sample time in seconds"
        )
    return {
        **{letter: np.asarray(getattr(system, letter), float) for letter in "ABCD"},
        "dt": None if system.dt == 0 else float(system.dt),
        "input_names": tuple(system.input_labels),
        "output_names": tuple(system.output_labels),
        "state_names": tuple(system.state_labels),
        "name": system.name if name is None else name,
    }


def _refuse_delays(model: StateSpace, library: str) -> None:
    if model.delay is not None:
        raise UsageError(
            f"model {model.name!r} has exact delays, which {library} does not support; "
            "replace them by Pade approximations first: with_pade(model, order)"
        )


def _labels(names: tuple[str, ...]) -> list[str]:
    """Return names without dots, which python-control reserves for itself."""
    return [name.replace(".", "_") for name in names]
