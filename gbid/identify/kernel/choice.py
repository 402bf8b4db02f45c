"""Choice of the kernel of a predictor: compiled, or the portable pass without a C compiler."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np

from gbid.core.compiled import CompilerMissingError
from gbid.core.notes import FitNote
from gbid.identify.kernel.compiled_linear import LONGEST_SOURCE, CompiledLinearKernel, KernelPattern, kernel_source
from gbid.identify.kernel.lanes import LanesRunner
from gbid.identify.kernel.linear import PortableLinearKernel
from gbid.identify.kernel.nonlinear import NonlinearKernel
from gbid.identify.kernel.portable import MappedRunner, MappedSteps
from gbid.identify.kernel.sample import NonlinearPredictor
from gbid.identify.kernel.sums import Kernel
from gbid.identify.predictor import GeneralPredictor

RunEngine = Literal["compiled", "numpy"]

MOST_INSTRUCTIONS = 60_000
"""Largest number of operations of all functions of a sample that are compiled: 10 000 take about 3 s."""


class ChosenKernel(NamedTuple):
    """Kernel, the name of its engine, and notes on its choice."""

    kernel: Kernel
    name: RunEngine
    notes: tuple[str, ...]


class _TooLargeError(Exception):
    """Error raised when a predictor would take minutes to compile; the text says what is large."""


def choose_kernel(predictor: GeneralPredictor, begin: Mapping[str, float]) -> ChosenKernel:
    """Return the kernel of a predictor.

    It is compiled if there is a C compiler and the predictor is not too large to be compiled in seconds. Otherwise it
    is the portable one, and a note says why.

    Parameters
    ----------
    predictor : Predictor or NonlinearPredictor
        The predictor.
    begin : dict of str to float
        Start values, which show the entries of a linear predictor that are always zero.
    """
    notes = []
    if isinstance(predictor, NonlinearPredictor) and predictor.jumps:
        notes.append(
            FitNote.JUMPS(
                f"the equations have jumps or kinks ({', '.join(predictor.jumps)}): the derivatives know only the "
                "pieces between them, so estimates of where they lie, and their standard deviations, are rough"
            )
        )
    try:
        kernel, note = _compiled(predictor, begin)
        return ChosenKernel(kernel, "compiled", (*([FitNote.SLOW_ENGINE(note)] if note else []), *notes))
    except _TooLargeError as large:
        reason = f"a compiled pass of {large} would take minutes to build: the slower portable pass was used"
    except (CompilerMissingError, NotImplementedError) as missing:
        reason = f"{missing}: the slower portable pass was used; install gcc, clang or gbid[compiler], or set CC"
    return ChosenKernel(_portable(predictor), "numpy", (FitNote.SLOW_ENGINE(reason), *notes))


def _compiled(predictor: GeneralPredictor, begin: Mapping[str, float]) -> tuple[Kernel, str]:
    """Return the compiled kernel, and a note if its library is not taken from the cache."""
    if isinstance(predictor, NonlinearPredictor):
        count = sum(f.n_instructions() for f in predictor.functions if isinstance(f, ca.Function))
        if count > MOST_INSTRUCTIONS:
            raise _TooLargeError(f"{count} operations")
        run = LanesRunner(predictor.functions)
        return NonlinearKernel(run, MappedSteps(predictor.functions)), run.note
    theta = np.array([begin.get(q.name, 0.0) for q in predictor.free])
    nudged = np.where(theta == 0, 1e-3, theta * 1.001)  # a point where nothing is zero by chance
    nudged = np.clip(nudged, [q.lower for q in predictor.free], [q.upper for q in predictor.free])
    pattern = KernelPattern.of(predictor.at(theta)).union(KernelPattern.of(predictor.at(nudged)))
    if len(kernel_source(pattern)) > LONGEST_SOURCE:
        raise _TooLargeError(f"{len(pattern.F)} states")
    kernel = CompiledLinearKernel(pattern)
    return kernel, kernel.note


def _portable(predictor: GeneralPredictor) -> Kernel:
    if isinstance(predictor, NonlinearPredictor):
        steps = MappedSteps(predictor.functions)
        return NonlinearKernel(MappedRunner(steps), steps)
    return PortableLinearKernel()
