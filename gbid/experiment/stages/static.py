"""Stage of the static characterisation: checks, maps and curves from staircases, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from gbid.core.errors import nearest
from gbid.core.hdf5 import load, save
from gbid.core.tables import table_of_records, write_csv
from gbid.experiment.experiment import Experiment
from gbid.experiment.fields import Found, Item, Location, Result
from gbid.experiment.recordings import load_made, recording_result, refuse_bad_signals
from gbid.experiment.run import Job, Made, Outcome, Stage, Task
from gbid.experiment.schema import wanted_signals
from gbid.prefilter import PiezoCurve, StaticMap
from gbid.prefilter.piezo import characterise_piezo
from gbid.prefilter.staircase import characterise_staircase

ONLY_FOR = {"bearing": ("source",), "piezo": ("channel", "command_channel", "settle_s", "limits")}
"""Keys that only one of the two kinds has."""


def static_makes_sense(experiment: Experiment) -> Found:
    """Yield problems of recordings, signals, and keys that belong to another kind of characterisation."""
    for name, section in experiment.spec.static.items():
        here: Location = ("static", name)
        chosen = experiment.matching(section.recordings)
        for pattern in section.recordings:
            if not experiment.matching((pattern,)):
                hint = nearest(pattern, experiment.recordings)
                yield (*here, "recordings"), f"no recording matches {pattern!r}; {hint}"
        if section.kind == "piezo" and len(chosen) > 1:
            names = ", ".join(q.name for q in chosen)
            yield (*here, "recordings"), f"a piezo is characterised from one recording, not {names}; name one"
        for kind, keys in ONLY_FOR.items():
            for key in keys:
                if kind != section.kind and getattr(section, key) is not None:
                    yield (*here, key), f"is for kind: {kind}; leave it out for kind: {section.kind}"
        if section.limits is not None and not section.limits[0] < section.limits[1]:
            yield (*here, "limits"), f"{list(section.limits)}: give the lower end first"
        for planned in chosen:
            for key, signal in wanted_signals(section).items():
                if signal not in planned.signals:
                    signals = ", ".join(planned.signals)
                    yield (*here, key), f"recording {planned.name!r} has no signal {signal!r}; it has {signals}"


FOLDER = "static"


def static_tasks(job: Job) -> list[Task]:
    """Return the tasks of the static sections, one for each characterisation."""
    return [
        Task.of(static_result(job.experiment, name), partial(_write, name=name), _recordings(job.experiment, name))
        for name in job.experiment.spec.static
    ]


def static_result(experiment: Experiment, name: str) -> Result:
    """Return the result file of a static characterisation."""
    sources = [recording_result(experiment, experiment.recordings[q]) for q in _recordings(experiment, name)]
    return experiment.result(Item("static", name), FOLDER, experiment.spec.static[name].model_dump(), sources)


def _recordings(experiment: Experiment, name: str) -> list[str]:
    return [planned.name for planned in experiment.matching(experiment.spec.static[name].recordings)]


def load_made_static(job: Job, name: str) -> StaticMap | PiezoCurve:
    """Return an existing static characterisation.

    Raises
    ------
    DataError
        When the file is missing.
    """
    path = job.path(FOLDER, name)
    if job.experiment.spec.static[name].kind == "piezo":
        return load(path, PiezoCurve)
    return load(path, StaticMap)


def _csv_tasks(job: Job, outcomes: Sequence[Outcome]) -> list[Task]:
    tasks = []
    for name in (outcome.item.section for outcome in outcomes if outcome.state != "failed"):
        item, source = Item("static", name, form="{} (csv)"), static_result(job.experiment, name)
        result = job.experiment.result(item, FOLDER, {}, [source], ending=".csv")
        tasks.append(Task.of(result, partial(_write_csv, name=name)))
    return tasks


def _write(job: Job, part: Path, name: str) -> Made:
    section = job.experiment.spec.static[name]
    options = section.model_dump(exclude={"kind", "recordings"}, exclude_none=True)
    data = []
    for planned in job.experiment.matching(section.recordings):
        data.append(load_made(job, planned))
        # The command rests at its limits and other axes do not move: only the measured signals are checked.
        measured = [signal for key, signal in wanted_signals(section).items() if key != "command"]
        refuse_bad_signals(planned, data[-1], measured, kinds=("too_few_samples", "dead", "swapped", "rub"))
    result: PiezoCurve | StaticMap
    if section.kind == "piezo":
        result = characterise_piezo(data[0], **options)
    else:
        result = characterise_staircase(data, **options)
    save(result, part, overwrite=True)
    return Made("; ".join(result.notes))


def _write_csv(job: Job, part: Path, name: str) -> None:
    write_csv(table_of_records(load_made_static(job, name).rows()), part)


STATIC = Stage("static", "static", (static_makes_sense,), static_tasks, (_csv_tasks,))
"""``static/<name>.h5`` for each static characterisation, and ``static/<name>.csv`` with its plateaus."""
