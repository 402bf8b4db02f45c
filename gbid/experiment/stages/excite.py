"""Checks of the excite section."""

from __future__ import annotations

from pathlib import Path

from gbid.core.errors import DataError, GbidError
from gbid.excite import Excitation, design_excitation, known_model, save_excitation
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, content_key, nearest
from gbid.experiment.recordings import excitation_limits
from gbid.experiment.run import Job, Made, Outcome, Stage, Task, Work
from gbid.experiment.stages.fit import fit_entries, model_key
from gbid.experiment.structures import fit_channels


def excitations_have_fits(experiment: Experiment) -> Found:
    """Yield a problem for each excitation whose fit does not exist or is no fit of driven recordings."""
    for name, section in experiment.spec.excite.items():
        if section.fit not in experiment.spec.fits:
            yield ("excite", name, "fit"), f"no fit {section.fit!r}; {nearest(section.fit, experiment.spec.fits)}"
            continue
        try:
            inputs, _ = fit_channels(experiment, section.fit)
        except GbidError:
            continue  # another check reports it
        if not inputs:
            yield ("excite", name, "fit"), f"fit {section.fit!r} has no inputs; there is nothing to excite"


# ---- Stage of the excitations of the next recordings.

FOLDER = "excite"


def excite_tasks(job: Job) -> Work:
    """Return a task for each model of the fit of each excitation; a failed outcome for a model that is missing."""
    work: list[Task | Outcome] = []
    for name, section in job.experiment.spec.excite.items():
        for entry in fit_entries(job, section.fit):
            item = f"{name}/{entry.model}"
            path = job.path(FOLDER, item, ".csv")
            if entry.result is None:
                work.append(Outcome("excite", item, path, "failed", entry.failure, cause="input"))
                continue
            planned = job.experiment.recordings[entry.recordings[0]]
            limits = excitation_limits(job.experiment, section, planned, entry.result.options.outputs)
            settings = {"limits": limits, **section.model_dump(exclude={"limits"})}
            key = content_key("excite", settings, [model_key(job.experiment, section.fit, entry.model)])
            work.append(Task("excite", item, path, key, _write, entry.recordings))
    return work


def designed(job: Job, item: str) -> tuple[Excitation, str]:
    """Return the excitation of an item and its content key.

    Raises
    ------
    DataError
        When the fit has no such model any more.
    """
    name, _, model = item.partition("/")
    section = job.experiment.spec.excite[name]
    for entry in fit_entries(job, section.fit):
        if entry.model == model and entry.result is not None:
            planned = job.experiment.recordings[entry.recordings[0]]
            limits = excitation_limits(job.experiment, section, planned, entry.result.options.outputs)
            settings = {"limits": limits, **section.model_dump(exclude={"limits"})}
            key = content_key("excite", settings, [model_key(job.experiment, section.fit, model)])
            made = design_excitation(
                known_model(entry.result, earlier=section.together),
                duration=section.duration_s,
                sample_time=entry.result.sample_time,
                limits=limits,
                kind=section.kind,
                focus=section.focus,
            )
            return made, key
    raise DataError(f"no model {model!r} of fit {section.fit!r}; make it with `gbid fit`")


def _write(job: Job, item: str, part: Path) -> Made:
    excitation, key = designed(job, item)
    save_excitation(excitation, part, overwrite=True, comment=f"content_key: {key}")
    counted = [
        100 * excitation.std[name] / abs(excitation.values[name])
        for name in excitation.counted
        if excitation.values[name]
    ]
    mean = f"mean std expected {sum(counted) / len(counted):.3g} %; " if counted else ""
    return Made(f"{mean}limits reached: {', '.join(excitation.reached) or 'none'}")


EXCITE = Stage("excite", "excite", (excitations_have_fits,), excite_tasks)
"""``excite/<name>/<model>.csv`` with the signals of the next recording, for the signal generator and the rig."""
