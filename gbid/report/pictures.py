"""Drawing of the figures of values, and the stage that draws the figures of an experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from gbid.core.errors import DataError, UsageError
from gbid.core.figures import Figure, Pictured
from gbid.core.tables import write_csv
from gbid.experiment.experiment import figure_pairs, fit_models
from gbid.experiment.fields import Item, Result, content_key
from gbid.experiment.run import Job, Outcome, produce
from gbid.experiment.stages.crossval import data_key, model_and_recording, residuals_on, validate_pair
from gbid.experiment.stages.fit import fit_result, load_made_fit, response_of
from gbid.identify.data import select
from gbid.identify.frequency_data import measured_response
from gbid.recording.quality import runs
from gbid.report import impact_pictures, loop_pictures, measured_pictures, model_pictures, surface_pictures
from gbid.report.canvas import Drawn, save_figure, shown_by_pyplot
from gbid.report.measured_pictures import plot_residuals, plot_response
from gbid.report.model_pictures import plot_bode


def plot(value: Any, ax: Any = None, **options: Any) -> Any:
    """Draw the first figure of a value.

    The method ``plot`` of these values does the same. Its figure belongs to ``matplotlib.pyplot``, so that notebooks
    and ``plt.show()`` show it. Figures of this function leave nothing behind.

    ======================================  ==================
    value                                   drawn by
    ======================================  ==================
    Recording                               `plot_recording`
    LinearModel, FitResult                  `plot_bode`
    FrequencyData, MeasuredResponse         `plot_bode`
    ModelComparison                         `plot_bode`
    SubspaceOrders                          `plot_orders`
    RecursiveResult                         `plot_recursive_fit`
    Profile                                 `plot_profile`
    Validation                              `plot_response`
    ResidualTest                            `plot_residuals`
    Sensitivities                           `plot_iso_zones`
    ======================================  ==================

    Parameters
    ----------
    value : one of the types above
        What to draw.
    ax : matplotlib Axes or array of them, optional
        Axes to draw into; a new figure when left out.
    **options
        Options of the function that draws.

    Returns
    -------
    matplotlib Axes or array of them
        The axes; their ``figure`` is the figure.

    Raises
    ------
    UsageError
        When no figure belongs to the type.
    """
    if not isinstance(value, Pictured):
        known = "FitResult, Recording and other results with `figures()`"
        raise UsageError(f"no picture belongs to {type(value).__name__}; there is one for {known}")
    return drawn(value.figures()[0], ax, **options)


_FILES = (impact_pictures, loop_pictures, measured_pictures, model_pictures, surface_pictures)


def drawn(figure: Figure, ax: Any = None, **options: Any) -> Any:
    """Draw a figure from its description: function, values and options."""
    function = next(vars(file)[figure.function] for file in _FILES if figure.function in vars(file))
    return function(*figure.values, ax=ax, **{**figure.options, **options})


def shown(value: Any, ax: Any = None, **options: Any) -> Any:
    """Draw the first figure of a value in a pyplot figure, so that a notebook shows it."""
    with shown_by_pyplot() if ax is None else nullcontext():
        return plot(value, ax, **options)


# ---- Stage that draws the figures of an experiment.

FOLDER = "figures"


def draw_figures(job: Job) -> list[Outcome]:
    """Write ``figures/<fit>_<model>_on_<recording>.png``, or other formats, for each fit with a figure.

    What is shown are the pairs of the fit's cross-validation; without one, each model on its own recordings. Where
    the experiment asks for the residuals, they come as ``..._residuals``; Bode diagrams come as ``..._bode``, with the
    numbers as csv. A model on each file of frequency responses of its fit comes as ``<fit>_<model>_response_1.png``.
    """
    outcomes = []
    experiment = job.experiment

    def draw(
        title: str, fit: str, picture: Callable[[], Drawn], settings: Mapping[str, Any], sources: list[str]
    ) -> None:
        for kind in experiment.spec.figures[fit].formats:
            path, key = (
                job.path(FOLDER, title, ending=f".{kind}"),
                content_key("figure", {"kind": kind, **settings}, sources),
            )
            write = partial(_save, picture, kind, key)
            outcomes.append(produce(job, Result(Item("figure", title, form=f"{{}}.{kind}"), path, key), write))

    pairs = [(fit, *pair) for fit in experiment.spec.figures for pair in figure_pairs(experiment, fit)]
    for fit, model, recording in pairs:
        name = f"{fit}_{model}_on_{recording}"
        try:
            sources = [fit_result(experiment, fit, model).key, data_key(experiment, fit, recording)]
        except (DataError, OSError) as error:
            outcomes.append(
                Outcome(
                    Item("figure", name), job.path(FOLDER, name, ending=".png"), "failed", str(error), cause="input"
                )
            )
            job.reporter.end(outcomes[-1])
            continue
        section, shown = experiment.spec.figures[fit], (job, fit, model, recording)
        if section.bode:
            path, key = job.path(FOLDER, f"{name}_bode", ending=".csv"), content_key("figure", {"kind": "csv"}, sources)
            numbers = partial(_save_bode, *shown, key)
            outcomes.append(produce(job, Result(Item("figure", name, form="{}_bode.csv"), path, key), numbers))
        draw(name, fit, partial(_response, *shown), section.model_dump(include={"from_s", "to_s"}), sources)
        if section.residuals:
            draw(f"{name}_residuals", fit, partial(_residuals, *shown), {"residuals": True}, sources)
        if section.bode:
            draw(f"{name}_bode", fit, partial(_bode, *shown), {"bode": True}, sources)
    for fit in experiment.spec.figures:
        for model, i in product(fit_models(experiment, fit), range(len(experiment.spec.fits[fit].responses))):
            title, source = f"{fit}_{model}_response_{i + 1}", fit_result(experiment, fit, model).key
            draw(title, fit, partial(_on_response, job, fit, model, i), {"response": i}, [source])
    return outcomes


def _on_response(job: Job, fit: str, model: str, i: int) -> Drawn:
    measured = response_of(job.experiment, fit, i)
    return plot_bode({f"model of {model}": load_made_fit(job, fit, model)}, measured=measured)


def _response(job: Job, fit: str, model: str, recording: str) -> Drawn:
    section = job.experiment.spec.figures[fit]
    return plot_response(validate_pair(job, fit, model, recording), from_s=section.from_s, to_s=section.to_s)


def _residuals(job: Job, fit: str, model: str, recording: str) -> Drawn:
    ahead = "one-step-ahead" if job.experiment.spec.fits[fit].focus == "prediction" else "simulation"
    title = f"{ahead} residuals of {fit}, model of {model} on {recording}"
    return plot_residuals(residuals_on(job, fit, *model_and_recording(job, fit, model, recording)), title=title)


def _bode(job: Job, fit: str, model: str, recording: str) -> Drawn:
    result, data = model_and_recording(job, fit, model, recording)
    options = result.options
    values, names, units = select(data, (*options.inputs, *options.outputs), gaps=True, irregular=True)
    complete = np.asarray(~np.isnan(values).any(axis=1))
    first, last = max(runs(complete), key=lambda run: run[1] - run[0])  # spectra take no gaps
    measured = measured_response(data[first:last], options.inputs, options.outputs, intersample=options.intersample)
    return plot_bode({f"model of {model}": result}, measured=measured, units=dict(zip(names, units, strict=True)))


def _save_bode(job: Job, fit: str, model: str, recording: str, key: str, part: Path) -> None:
    result, _ = model_and_recording(job, fit, model, recording)
    write_csv(result.bode().table(), part, (f"content_key: {key}",))


def _save(picture: Callable[[], Drawn], kind: str, key: str, part: Path) -> None:
    save_figure(picture(), part, kind=kind, note=f"content_key: {key}")
