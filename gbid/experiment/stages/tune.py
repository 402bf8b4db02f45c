"""Stage of the tuned controllers: checks, designs, assessments, and controller files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from gbid import control, lpv
from gbid.control.loop.close import too_slow_for
from gbid.control.tuning.design_options import DesignOptions
from gbid.core.errors import GbidError, nearest
from gbid.core.files import scratch_folder
from gbid.core.hdf5 import load, save
from gbid.experiment.controllers import (
    TUNED,
    controller_section,
    design_result,
    design_structure,
    goal_recordings,
    is_fitted,
    load_design,
    made_goal,
    named_model,
    no_disturbance,
    peak_cap,
    published_design,
    published_structure,
    sample_time,
    surfaces_item,
    with_actuators,
    without_cap,
)
from gbid.experiment.experiment import Experiment, fit_models
from gbid.experiment.fields import Found, InputError, Item, Location, Result, needed, refusal, stored_key
from gbid.experiment.machine import machine_data, outside_domain
from gbid.experiment.recordings import load_made, recording_result
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work
from gbid.experiment.schema import ControllerSection, RobustSection
from gbid.experiment.stages.fit import fit_result, load_made_fit
from gbid.experiment.stages.lpv import FOLDER as LPV_FOLDER
from gbid.experiment.stages.lpv import read_surfaces, surfaces_domain

if TYPE_CHECKING:
    from gbid.control.assessment import CappedDesign, DesignFigures, RobustPromise, TunedDesign


def designs_can_be_tuned(experiment: Experiment) -> Found:
    """Yield errors in the structure, model, gains, goals and operating points of each design."""
    for name, section in experiment.spec.controller.items():
        for where, text in _design_problems(experiment, section):
            yield ("controller", name, *where), text


def _design_problems(experiment: Experiment, section: ControllerSection) -> Found:
    """Yield problems of a design at locations relative to its section."""
    model: lpv.LPVModel | None = None
    named: Location = ("model",) if section.model else ()
    try:
        item = surfaces_item(experiment, section)
    except GbidError as error:
        yield ("model",), str(error)
        return
    for key, value in (("inputs", section.inputs), ("outputs", section.outputs)):
        if value is not None and not is_fitted(experiment, section):
            yield (key,), "chooses channels of the models of a fit; leave it out"
    if is_fitted(experiment, section):
        yield from _fitted_problems(experiment, section)
    elif item is None:
        try:
            model = named_model(experiment, section)
        except GbidError as error:
            yield named, str(error)
            return
        for key in ("uncertainty", "robust"):
            if getattr(section, key) is not None:
                yield (key,), "needs the surfaces of this experiment; write model: lpv"
        yield from _point_problems(section, model)
    else:
        surfaces = needed(experiment.spec.lpv, "lpv")
        if surfaces.actuators is None:
            yield named, "the surfaces have no actuators; add lpv: actuators"
        if section.model == "lpv_direct" and not surfaces.direct:
            yield ("model",), "there are no surfaces of a direct LPV fit; write lpv: direct: true"
    if section.robust is not None:
        if section.goals is None:
            yield ("robust",), "needs goals; list them, such as goals: [{goal: MaxDamping}]"
        if section.uncertainty is not None:
            yield ("uncertainty",), "comes with robust already; leave it out"
        if section.pareto:
            yield ("pareto",), "is not for robust designs; write price: [...] below robust, or a second design"
    if section.goals is not None and not is_fitted(experiment, section):
        known = machine_data(experiment) if model is None else model.machine
        yield from _goal_problems(experiment, section, known)
    try:
        known_domain = surfaces_domain(experiment) if item is not None else None if model is None else model.domain
        structure = design_structure(experiment, section, known_domain)
    except GbidError as error:
        yield (error.key or "structure",), str(error)
        return
    gains = [parameter.name for parameter in structure.parameters]
    for key, given in (("bounds", section.bounds), ("start", section.start)):
        for gain in given:
            if gain not in gains:
                yield (key, gain), f"{structure.name} has no gain of this name; {nearest(gain, gains)}"
    for gain, (low, high) in section.bounds.items():
        if not low < high:
            yield ("bounds", gain), f"lower bound {low:g} is not below the upper one, {high:g}"


def _fitted_problems(experiment: Experiment, section: ControllerSection) -> Found:
    """Yield a problem for each option that a design for models of a fit cannot have."""
    if experiment.spec.fits[str(section.model)].loop is not None:
        yield ("model",), f"fit {section.model!r} is of a loop with its controller; name a fit of the plant alone"
    for key in ("operating_points", "schedule", "uncertainty", "robust"):
        if key in section.model_fields_set and getattr(section, key) is not None:
            yield (key,), "needs surfaces over pressure and speed, not a fit; leave it out"


def _point_problems(section: ControllerSection, model: lpv.LPVModel) -> Found:
    if section.operating_points == "model" and not model.operating_points:
        where: Location = ("operating_points",) if "operating_points" in section.model_fields_set else ()
        yield where, f"model {model.name!r} lists no operating points; list some, or write domain"
    if not isinstance(section.operating_points, str):
        yield from refusal(("operating_points",), model.need_bearing)
        for i, point in enumerate(section.operating_points):
            yield from outside_domain(model.domain, model.name, point, ("operating_points", i))


def _goal_problems(experiment: Experiment, section: ControllerSection, known: lpv.MachineData) -> Found:
    entries = section.goals or ()
    for key in ("peak_sensitivity", "objective"):
        if key in section.model_fields_set:
            yield (key,), "stands beside goals; write it as a goal, too"
    goals = []
    for i, entry in enumerate(entries):
        try:
            goals.append(made_goal(entry, no_disturbance))
        except GbidError as error:
            yield ("goals", i), str(error)
        for pattern in entry.arguments.get("disturbance", ()):
            for text in _disturbance_problems(experiment, pattern):
                yield ("goals", i, "disturbance"), text
    if len(goals) == len(entries):
        from gbid.control.tuning.goals import limits_of

        plant = lpv.load_model("theisen2016").plant_at(6.0, 0.0)  # every plant has the channels of this one
        yield from refusal(("goals",), lambda: limits_of(goals, plant, known))


def _disturbance_problems(experiment: Experiment, pattern: str) -> Iterator[str]:
    matching = experiment.matching((pattern,))
    if not matching:
        yield f"no recording {pattern!r}; {nearest(pattern, experiment.recordings)}"
    for planned in matching:
        if not planned.stationary:
            yield f"recording {planned.name!r} is not stationary; its spectrum is not that of a disturbance"
        elif "p" not in planned.signals:
            yield f"recording {planned.name!r} has no signal p, only {', '.join(planned.signals)}"


PUBLISHED = "published"
"""Name of the published controller in tables of designs."""


def design_tasks(job: Job) -> Work:
    """Return the tasks of the controller section, one per design; failed outcomes for designs without plants."""
    work: list[Task | Outcome] = []
    surfaces = _surfaces(job)
    for name in job.experiment.spec.controller:
        try:
            work.append(design_task(_result(job, name, surfaces)))
        except GbidError as error:
            path = job.path(TUNED, name)
            work.append(Outcome(Item("tune", name), path, "failed", str(error), cause="input"))
    return work


def design_task(result: Result) -> Task:
    """Return the task that tunes a design."""
    return Task.of(result, partial(_write_design, name=result.item.section), read=_read_design_summary)


def controller_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    """Return the tasks of the controller files of tuned designs; each file has the content key of its design."""
    done = {outcome.path for outcome in outcomes if outcome.state != "failed"}
    tasks = []
    for name in job.experiment.spec.controller:
        design = job.path(TUNED, name)
        if design in done:
            file = Result(Item("controller", name), design.with_suffix(".yaml"), stored_key(design))
            tasks.append(Task.of(file, partial(_write_controller, name=name)))
    return tasks


def read_designs(job: Job) -> tuple[dict[str, TunedDesign], dict[str, str]]:
    """Return the existing designs for the present settings and fits, by name; nothing is computed.

    Returns
    -------
    designs : dict of str to TunedDesign
        Existing designs by name.
    missing : dict of str to str
        Reason for each missing design, by name.
    """
    designs: dict[str, TunedDesign] = {}
    missing: dict[str, str] = {}
    surfaces = _surfaces(job)
    for name in job.experiment.spec.controller:
        try:
            result = _result(job, name, surfaces)
            if result.is_made:
                designs[name] = load_design(result.path)
            else:
                made = "made with other settings or data" if result.path.is_file() else "not made yet"
                missing[name] = f"{made}; `gbid tune` makes it"
        except GbidError as error:
            missing[name] = str(error)
    return designs, missing


def _surfaces(job: Job) -> Collection[str]:
    """Return the names of the existing surfaces of the present fits; empty if no design needs them."""
    experiment = job.experiment
    if all(surfaces_item(experiment, section) is None for section in experiment.spec.controller.values()):
        return ()
    return read_surfaces(job).keys()


def _result(job: Job, name: str, surfaces: Collection[str]) -> Result:
    """Return the result file of a design.

    Raises
    ------
    InputError
        When its surfaces are not made from the present fits.
    """
    experiment, section = job.experiment, controller_section(job.experiment, name)
    item = surfaces_item(experiment, section)
    if item is not None and item not in surfaces:
        raise InputError(f"there are no surfaces {item!r} made from the present fits; run `gbid lpv` or `gbid run`")
    path = None if item is None else job.path(LPV_FOLDER, item, ending=".yaml")
    sources = [recording_result(experiment, planned) for planned in goal_recordings(experiment, section)]
    if is_fitted(experiment, section):
        fit = str(section.model)
        sources += [fit_result(experiment, fit, model) for model in fit_models(experiment, fit)]
    return design_result(experiment, name, path, sources)


def design_plant(job: Job, section: ControllerSection) -> tuple[Any, control.Uncertainty | None]:
    """Return the plants of a design: an LPV model with uncertainty if the section asks for it, or fits by name."""
    if is_fitted(job.experiment, section):
        fit = str(section.model)
        return {f"{fit}_{model}": load_made_fit(job, fit, model) for model in fit_models(job.experiment, fit)}, None
    item = surfaces_item(job.experiment, section)
    if item is None:
        return named_model(job.experiment, section), None
    surfaces, drawn = load(job.path(LPV_FOLDER, item), lpv.LPVFit), section.uncertainty
    model = with_actuators(surfaces.model)
    if section.robust is not None:
        return model, control.Uncertainty(surfaces.covariance, scatter=surfaces.scatter)
    if drawn is None:
        return model, None
    if drawn.plants == "recordings":
        return model, control.Uncertainty(samples=surfaces.estimates.values - surfaces.surface)
    return model, control.Uncertainty(surfaces.covariance, draws=drawn.draws, seed=drawn.seed)


def _travel_goal(section: ControllerSection) -> control.PiezoTravel | None:
    """Return the first goal on the travel of the stacks; None if no goal limits it."""
    made = (made_goal(entry, no_disturbance) for entry in section.goals or () if entry.goal == "PiezoTravel")
    return cast("control.PiezoTravel | None", next(made, None))


def impact(section: ControllerSection) -> control.HalfSine:
    """Return the impact for the assessment of designs: from the goals, or the default."""
    goal = _travel_goal(section)
    return control.HalfSine() if goal is None else goal.impact


def tune_options(section: ControllerSection) -> dict[str, Any]:
    """Return the arguments of `gbid.tune` from the section, except model, structure and cap."""
    points: Any = section.operating_points
    if not isinstance(points, str):
        points = [(q.pressure_bar, q.speed_rpm) for q in points]
    left_out = ("peak_sensitivity",) if section.goals is None else ("peak_sensitivity", "objective")
    options = {f.name: getattr(section, f.name) for f in fields(DesignOptions) if f.name not in left_out}
    points = None if points == "model" else points
    return {**options, "operating_points": points, "inputs": section.inputs, "outputs": section.outputs}


def assess_options(experiment: Experiment, section: ControllerSection) -> dict[str, Any]:
    """Return the arguments of `gbid.control.assess` from the section, except the points and channels."""
    goal = _travel_goal(section)
    return {
        "sample_time": sample_time(experiment, section),
        "method": section.method,
        "impact": impact(section),
        "piezo_travel_m": None if goal is None else goal.travel_m,
    }


def _write_design(job: Job, part: Path, name: str) -> Made:
    experiment, section = job.experiment, controller_section(job.experiment, name)
    model, plants = design_plant(job, section)
    structure: Any = design_structure(experiment, section, getattr(model, "domain", None))

    def disturbance(patterns: tuple[str, ...]) -> control.DisturbanceSpectrum:
        return control.recorded_disturbance([load_made(job, planned) for planned in experiment.matching(patterns)])

    goals = None if section.goals is None else [made_goal(entry, disturbance) for entry in section.goals]
    options: dict[str, Any] = {
        **tune_options(section),
        "controller": structure,
        "uncertainty": plants,
        "sample_time": sample_time(experiment, section) if section.design_for == "sampled" else None,
        "progress": job.reporter.search,
    }
    from gbid.control.assessment import CappedDesign, DesignFigures, TunedDesign

    promises: tuple[RobustPromise, ...] = ()
    front: tuple[CappedDesign, ...] = ()
    if section.robust is not None:
        assert goals is not None
        result, promises = _robust(model, section.robust, goals, options)
    else:
        limits: dict[str, Any] = {"goals": goals} if goals else {"peak_sensitivity": section.peak_sensitivity}
        result = control.tune(model, **limits, **options)
        if section.pareto:
            others = control.pareto(
                model, section.pareto, goals=without_cap(section, goals) if goals else None, **options
            )
            front = tuple(map(CappedDesign, others.caps, others.designs))
    if section.design_for == "sampled":
        laws = (control.controller_at(structure, result.gains, *point) for point in result.points or [(0.0, 0.0)])
        slow = next(filter(None, (too_slow_for(law, options["sample_time"]) for law in laws)), "")
        note = f"`gbid export --to c` refuses this controller: {slow}; or tune with a lower lowpass_hz"
        result = replace(result, notes=(*result.notes, *([note] if slow else ())))
    channels: dict[str, Any] = {"inputs": section.inputs, "outputs": section.outputs, "name": name}
    points = result.points or None
    assessed = control.assess(model, structure, result.gains, points, **channels, **assess_options(experiment, section))
    published = assess_published(experiment, model, section, points)
    figures = (DesignFigures.of(assessed), *(() if published is None else (published,)))
    plant = model.name if isinstance(model, lpv.LPVModel) else next(iter(model)) if len(model) == 1 else section.model
    hit = impact(section).on(model.machine) if isinstance(model, lpv.LPVModel) else impact(section)
    sampling = (sample_time(experiment, section), section.method)
    design = TunedDesign(name, str(plant), result, figures, front, hit, *sampling, promises)
    save(design, part, overwrite=True)
    return _made(design)


def _robust(
    model: lpv.LPVModel, section: RobustSection, goals: Sequence[control.Goal], options: Mapping[str, Any]
) -> tuple[control.GainResult, tuple[RobustPromise, ...]]:
    """Return the robust design for the stated probability, and its predicted performance for all probabilities."""
    from gbid.control.assessment import RobustPromise

    numbers = {key: getattr(section, key) for key in ("confidence", "draws", "fresh", "seed")}
    probabilities = (section.probability, *section.price)
    price = control.price_of_robustness(model, goals=goals, probabilities=probabilities, **{**options, **numbers})
    promises = tuple(
        RobustPromise(
            p,
            design.confidence,
            design.promised,
            design.keeps_limits,
            len(design.plants),
            len(design.fresh.value),
            plain,
            price.limits_of_nominal,
            price.nominal,
        )
        for p, design, plain in zip(price.probabilities, price.designs, price.of_nominal, strict=True)
    )
    return price.designs[price.probabilities.index(section.probability)].result, promises


def assess_published(
    experiment: Experiment, model: lpv.LPVModel, section: ControllerSection | None = None, points: Any = None
) -> DesignFigures | None:
    """Return the assessment of the published controller of a model; None if it has none.

    Without a section, as in experiments without designs, the conditions are those of an empty section ``controller``:
    operating points of the model, sample time of the rig.
    """
    from gbid.control.assessment import DesignFigures

    published = published_design(experiment, section)
    if published is None:
        return None
    options = assess_options(experiment, section or ControllerSection())
    gains = {"kappa_x": published.kappa_x, "kappa_y": published.kappa_y}
    points = model.operating_points if points is None else points
    return DesignFigures.of(
        control.assess(model, published_structure(published), gains, points, name=PUBLISHED, **options)
    )


def _made(design: TunedDesign) -> Made:
    result = design.result
    stuck = [f"under the cap {cap:g}: {entry.status}" for cap, entry in design.front if not entry.success]
    if result.success:
        return Made("; ".join(stuck))
    if result.keeps_limits:
        text = f"{result.status}: all limits are kept, without a certificate; see the notes of the design"
        return Made("; ".join([text, *stuck]), converged=False)
    worst = result.worst
    mode = f"{worst.frequency_hz:.0f} Hz with damping {worst.damping:.3f} at {worst.where}"
    active = f", limited by {', '.join(result.active)}" if result.active else ""
    text = f"{result.status}: limits exceeded by {100 * result.violation:.2g} %{active}; worst mode {mode}"
    return Made("; ".join([text, *stuck]), converged=False)


def _read_design_summary(path: Path) -> Made:
    return _made(load_design(path))


def _write_controller(job: Job, part: Path, name: str) -> None:
    section, design = controller_section(job.experiment, name), load_design(job.path(TUNED, name))
    model = None if is_fitted(job.experiment, section) else design_plant(job, section)[0]
    structure = design_structure(job.experiment, section, None if model is None else model.domain)
    result = design.result
    provenance: dict[str, str | float] = {
        "experiment": job.experiment.spec.name,
        "status": str(result.status),
        result.objective: result.value,
        "verified_on": result.verified_on,
    }
    machine = {} if model is None else vars(model.machine)
    provenance |= {name: value for name, value in machine.items() if value is not None}
    for key, channels in (("drives", section.inputs), ("measures", section.outputs)):
        provenance |= {} if channels is None else {key: ", ".join(channels)}
    cap = peak_cap(section)
    if cap is not None:
        provenance["cap_peak_sensitivity"] = cap
    if result.peak_sensitivity is not None:
        provenance["peak_sensitivity"] = result.peak_sensitivity
    with scratch_folder(part) as folder:  # save_controller chooses the format by the ending
        file = folder / "controller.yaml"
        control.save_controller(
            file,
            structure,
            result.gains,
            name=name,
            sample_time=sample_time(job.experiment, section),
            method=section.method,
            plant=design.plant,
            points=result.points if isinstance(structure, control.Scheduled) else (),
            provenance=provenance,
        )
        file.replace(part)


TUNE = Stage("tune", "controller", (designs_can_be_tuned,), design_tasks, (controller_tasks,))
"""``controller/<design>.h5`` and ``controller/<design>.yaml``.

A design that does not meet all limits counts as not converged; it is written.
"""
