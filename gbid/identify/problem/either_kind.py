"""Predictor and kernel of a structure, by its kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gbid.identify.disturbances.disturbances import Disturbances
from gbid.identify.kernel.engine import EngineName, RunEngine, choose_engine
from gbid.identify.kernel.general_predictor import GeneralPredictor
from gbid.identify.kernel.kernel_protocol import Kernel
from gbid.identify.kernel.linear_kernel import LinearKernel
from gbid.identify.nonlinear.nonlinear_predictor import (
    NonlinearPredictor,
    build_nonlinear_predictor,
    nonlinear_noise_names,
)
from gbid.identify.nonlinear.runner import choose_runner
from gbid.identify.predictor import Focus, Predictor, build_predictor, noise_names
from gbid.notes.fit_notes import FitNote
from gbid.structure import AnyStructure, NonlinearStructure, ScheduledStructure


def any_predictor(
    structure: AnyStructure,
    fixed: Mapping[str, float],
    begin: Mapping[str, float],
    sample_time: float,
    intersample: str | Sequence[str],
    focus: Focus,
    *,
    disturbances: Disturbances,
    horizon: int,
    released: Sequence[bool],
) -> GeneralPredictor:
    """Return the predictor of a structure of either kind for a fit; see `build_predictor`.

    `begin` are the start values.
    """
    if isinstance(structure, NonlinearStructure):
        return build_nonlinear_predictor(
            structure,
            fixed,
            begin,
            sample_time,
            intersample,
            focus,
            disturbances=disturbances,
            horizon=horizon,
            released=released,
        )
    assert not isinstance(structure, ScheduledStructure)  # a fit poses its base
    return build_predictor(
        structure,
        fixed,
        sample_time,
        intersample,
        focus,
        disturbances=disturbances,
        horizon=horizon,
        released=released,
    )


def any_noise_names(structure: AnyStructure) -> frozenset[str]:
    """Return the names of the parameters on which only the disturbance gain depends."""
    if isinstance(structure, ScheduledStructure):
        structure = structure.base
    return nonlinear_noise_names(structure) if isinstance(structure, NonlinearStructure) else noise_names(structure)


class ChosenKernel(NamedTuple):
    """Kernel, the name of its engine, and notes on its choice."""

    kernel: Kernel
    name: RunEngine
    notes: tuple[str, ...]


def choose_kernel(wanted: EngineName, predictor: GeneralPredictor, begin: Mapping[str, float]) -> ChosenKernel:
    """Return the kernel of a predictor.

    Parameters
    ----------
    wanted : {"auto", "compiled", "numpy"}
        Engine that the caller wants.
    predictor : Predictor or NonlinearPredictor
        The predictor.
    begin : dict of str to float
        Start values, at which the linear engine looks which entries of the predictor are zero for good.

    Raises
    ------
    UsageError
        When the compiled engine is required and there is no compiler.
    """
    if isinstance(predictor, NonlinearPredictor):
        kernel, name, note = choose_runner(wanted, predictor)
        jumps = FitNote.JUMPS(
            f"the equations have jumps or kinks ({', '.join(predictor.jumps)}): the derivatives know only the pieces "
            "between them, so estimates of where they lie, and their standard deviations, are rough"
        )
        return ChosenKernel(
            kernel, name, (*([FitNote.SLOW_ENGINE(note)] if note else []), *([jumps] if predictor.jumps else []))
        )
    assert isinstance(predictor, Predictor)
    theta = np.array([begin.get(q.name, 0.0) for q in predictor.free])
    nudged = np.where(theta == 0, 1e-3, theta * 1.001)  # a point where nothing is zero by chance
    nudged = np.clip(nudged, [q.lower for q in predictor.free], [q.upper for q in predictor.free])
    chosen = choose_engine(wanted, [predictor.at(theta), predictor.at(nudged)])
    return ChosenKernel(
        LinearKernel(chosen.run), chosen.name, (FitNote.SLOW_ENGINE(chosen.note),) if chosen.note else ()
    )
