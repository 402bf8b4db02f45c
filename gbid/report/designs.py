"""Tuned designs beside the one that came with the machine: their figures, and the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbid.control.assessment.compare import COLUMNS
from gbid.control.assessment.tuned_design import DesignFigures, TunedDesign
from gbid.control.tuning.gain_result import GainResult
from gbid.errors import DataError
from gbid.report.tuning import ParetoFront, pareto_data


def comparable_designs(designs: Mapping[str, TunedDesign]) -> dict[str, TunedDesign]:
    """Choose those designs that were tuned on the same plant for the same points and aim as the first one.

    Raises
    ------
    DataError
        When there are none.
    """
    if not designs:
        raise DataError("no tuned design of the present settings and fits is there; run `gbid tune` or `gbid run`")
    first = next(iter(designs.values()))
    return {name: design for name, design in designs.items() if _terms(design) == _terms(first)}


def _terms(design: TunedDesign) -> tuple[object, ...]:
    points = tuple(map(tuple, design.performance[0].points)) if design.performance else ()
    return design.plant, points, design.result.objective, design.result.sample_time, design.impact, design.sample_time


def design_performances(designs: Mapping[str, TunedDesign]) -> list[DesignFigures]:
    """List the performance of comparable designs, the published one last.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = list(comparable_designs(designs).values())
    return [*(design.performance[0] for design in chosen if design.performance), *chosen[0].performance[1:]]


def design_rows(performances: list[DesignFigures]) -> list[tuple[str, ...]]:
    """Lay out the worst figures of designs, a row for each figure."""
    worst = [performance.worst for performance in performances]
    return [
        (heading, *(format(factor * found[figure][0], form) for found in worst))
        for heading, figure, factor, form in COLUMNS
    ]


def designs_pareto_data(designs: Mapping[str, TunedDesign]) -> ParetoFront:
    """Give the fronts of comparable designs with the published design on them, for `plot_pareto`.

    Parameters
    ----------
    designs : dict of str to TunedDesign
        By name; each with its designs under other caps.

    Returns
    -------
    ParetoFront
        By structure; designs that keep not all their limits are left out.

    Raises
    ------
    DataError
        When there are no designs.
    """
    chosen = comparable_designs(designs)
    fronts: dict[str, list[tuple[float, float]]] = {}
    for name, design in chosen.items():
        results = [design.result, *(result for _, result in design.front)]
        label = design.performance[0].structure if design.performance else name
        label = name if label in fronts else label
        fronts[label] = [_place(result) for result in results if result.success and result.peak_sensitivity is not None]
    first, marked = next(iter(chosen.values())), {}
    runs = first.result.sample_time is not None
    figures = ("sampled_peak_output", "sampled_damping") if runs else ("peak_output", "damping")
    for performance in design_performances(designs)[len(chosen) :]:
        peak, damping = (performance.worst[figure][0] for figure in figures)
        if np.isfinite([peak, damping]).all():
            marked[performance.name] = (peak, damping)
    title = f"{first.plant}, worst of {len(first.result.points)} operating points"
    if first.result.sample_time is not None:
        title += f", sampled at {1e3 * first.result.sample_time:g} ms"
    return pareto_data(fronts, marked, title)


def _place(result: GainResult) -> tuple[float, float]:
    assert result.peak_sensitivity is not None
    return result.peak_sensitivity, result.value
