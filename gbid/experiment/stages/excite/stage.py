"""Stage of the excitations of the next recordings."""

from __future__ import annotations

from pathlib import Path

from gbid.errors import DataError
from gbid.excite import Excitation, design_excitation, known_model, save_excitation
from gbid.experiment.keys import content_key
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Made, Outcome
from gbid.experiment.run.stage import Stage, Work
from gbid.experiment.stages.excite.checks import excitations_have_fits
from gbid.experiment.stages.excite.plan import excitation_limits
from gbid.experiment.stages.fit.stage import fit_entries, model_key

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
