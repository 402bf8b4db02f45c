"""Remarks and figures of a finished design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbid.control.controllers.scheduled import Scheduled
from gbid.control.tuning.gain_result import GainResult, GoalFigure
from gbid.control.tuning.plants.plants_of import DesignPlants
from gbid.control.tuning.plants.sampled_loops import Sampling
from gbid.control.tuning.search.loop_delay import smallest_sampled_damping
from gbid.control.tuning.search.problem import GainProblem
from gbid.control.tuning.search.sqp import LocalOptimum
from gbid.control.tuning.verify import distance_to_edge
from gbid.notes.control_notes import ControlNote
from gbid.operating_point import point_label
from gbid.structure.linear import Structure


def notes_of(
    design: DesignPlants,
    problem: GainProblem,
    optimum: LocalOptimum,
    names: tuple[str, ...],
    structure: Structure | Scheduled,
    points: tuple[tuple[float, float], ...],
    sampling: Sampling | None,
) -> tuple[str, ...]:
    """Return the remarks on a design: unfinished fits, unstable open loops, distance to the edge, the sampled loop."""
    labels = [point_label(P, Omega) for P, Omega in design.points]
    if design.lpv is None:
        labels = list(problem.families[0].labels)
    unstable = [label for label, rate in zip(labels, design.slowest, strict=True) if rate < 0]
    notes = tuple(
        ControlNote.FIT_NOT_CONVERGED(f"the plant {fit.model.name!r} is a fit that did not converge")
        for fit in design.unfinished
    )
    if unstable:
        notes += (ControlNote.UNSTABLE_OPEN_LOOP(f"the open loop is not stable at {'; '.join(unstable)}"),)
    notes += _edge_notes(problem, optimum, names)
    if sampling is not None and design.lpv is not None:
        gains = dict(zip(names, map(float, optimum.x), strict=True))
        truly, (P, Omega) = smallest_sampled_damping(
            design.lpv, structure, gains, sorted(points), sampling.sample_time, sampling.computation_s, sampling.method
        )
        text = (
            f"designed for sampling at {1e3 * sampling.sample_time:g} ms with {1e3 * sampling.computation_s:g} ms to "
            f"compute; the sampled loop has a smallest damping factor of {truly:.3f}, at {point_label(P, Omega)}"
        )
        notes += (ControlNote.SAMPLED_LOOP(text),)
    return notes


def goal_figures(problem: GainProblem, optimum: LocalOptimum, result: GainResult) -> GainResult:
    """Return the result with the figures of goals beside those that have a field, and with the damping it reached."""
    limits = problem.limits
    if not limits.measures:
        return result
    figures = []
    states = [problem.state(family, family.matrices(optimum.x), optimum.x) for family in problem.families]
    for measure in limits.measures:
        found = [(float(e), name) for s in states for e, name in zip(measure.excess(s), s.family.labels, strict=True)]
        figures.append(GoalFigure(measure.name, measure in limits.soft, *max(found)))
    result = replace(result, goals=tuple(figures))
    if not limits.soft:
        return result
    if not limits.weight:
        return replace(result, objective="goals")
    worst = result.worst
    decay = 2 * np.pi * worst.frequency_hz * worst.damping
    return replace(result, value=worst.damping if limits.objective == "damping" else decay)


def _edge_notes(problem: GainProblem, found: LocalOptimum, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a note on the distance to instability of a design without a limit on a response."""
    if problem.limits.peak_sensitivity is not None or problem.limits.measures or not problem.stable(found.x):
        return ()
    edge = distance_to_edge(problem, found.x, names)
    note = "damping alone was maximised: the peak of S_o is not limited"
    if np.isfinite(edge.change):
        note += f"; a change of {edge.gain} by {edge.change:+.2g} makes a loop unstable"
    return (ControlNote.PEAK_NOT_LIMITED(note),)
