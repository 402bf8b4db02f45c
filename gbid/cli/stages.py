"""Stages of a verb: run them and print their outcomes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from gbid.cli.options import CommonOptions
from gbid.cli.printing import print_json, print_notes, print_tables, tell
from gbid.cli.progress import causes_in_words, reporting
from gbid.core.errors import DataError, GbidError, NotConvergedError, ThresholdError, UsageError
from gbid.core.files import remove_stale_parts
from gbid.core.tables import Column, Table
from gbid.experiment.campaign import working
from gbid.experiment.experiment import Experiment, changed_files
from gbid.experiment.fields import nearest
from gbid.experiment.run import Job, Outcome, Stage, Task, run_stage, run_tasks, standing
from gbid.experiment.stages import registry
from gbid.experiment.stages.fit import FIT, fit_tasks
from gbid.report.views import view_of

# ---- Command that one would sensibly give next, from the sections that an experiment has.

_ORDER: Mapping[str, Callable[[Any], object]] = {
    "check": lambda _: True,
    "rig": lambda spec: spec.rig,
    "import": lambda spec: spec.imported,
    "static": lambda spec: spec.static,
    "fit": lambda spec: spec.fits,
    "crossval": lambda spec: spec.crossval,
    "lpv": lambda spec: spec.lpv,
    "excite": lambda spec: spec.excite,
    "tune": lambda spec: spec.controller,
    "impact": lambda spec: spec.impacts,
    "cycle": lambda spec: spec.cycle,
    "report": lambda _: True,
    "export": lambda spec: spec.fits or spec.lpv or spec.controller,
}
"""Verbs in the order of the work, with what an experiment must have for them."""
_LIKE = {"batch": "fit", "run": "report", "figures": "cycle", "reproduce": "cycle"}


def next_step(experiment: Experiment, verb: str) -> str:
    """Return the command that follows a verb; empty after the last one.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    verb : str
        The verb that has just ended well.
    """
    path = experiment.file.path
    if verb == "check":
        return f"gbid run {path}"
    if verb == "run" and experiment.spec.cycle is not None and not experiment.spec.cycle.in_run:
        return f"gbid cycle {path}"
    verbs = list(_ORDER)
    for later in verbs[verbs.index(_LIKE.get(verb, verb)) + 1 :]:
        if _ORDER[later](experiment.spec):
            target = " --to c" if experiment.spec.controller else " --to matlab"
            return f"gbid {later} {path}{target if later == 'export' else ''}"
    return ""


# ---- Exit code of a verb, and its messages about failed items.

_MISSED = 20  # largest number of pairs below the minimum that are listed
_CODES = {"defect": GbidError.exit_code, "usage": UsageError.exit_code}


def outcome_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return outcomes as plain rows."""
    return [
        {
            "stage": o.stage,
            "item": o.item,
            "state": o.state,
            "path": str(o.path),
            "converged": o.converged,
            "text": o.text,
            "cause": o.cause,
            "failed_before": o.before,
        }
        for o in outcomes
    ]


def finish(outcomes: Sequence[Outcome], validated: Sequence[Mapping[str, Any]] = (), advice: str = "") -> None:
    """Say on standard error what failed, and end with the exit code: the lowest that applies, or 0.

    The last line is the first cause. Results whose inputs failed in this run have no lines of their own.

    Parameters
    ----------
    outcomes : sequence of Outcome
        Outcomes of the verb.
    validated : sequence of dict
        Rows of cross-validations as documents.
    advice : str
        Command to give next when all went well; empty for none.
    """
    failed = [o for o in outcomes if o.state == "failed"]
    stuck = [o for o in outcomes if o.state != "failed" and not o.converged]
    missed = [row for row in validated if row["missed"]]
    code = _exit_code(failed, stuck, missed)
    for o in stuck:
        tell(f"gbid: error: {o.stage} {o.item}: {o.text} (written to {o.path})")
    for row in sorted(missed, key=lambda row: row["fit_percent"])[:_MISSED]:
        tell(
            f"gbid: error: crossval {row['fit']}: model of {row['model']} on {row['recording']}: "
            f"{row['output']} {row['fit_percent']:.2f} %, below the minimum of {row['minimum_percent']:g} %; "
            "look at its figures (`residuals: true`), or lower minimum_percent"
        )
    if len(missed) > _MISSED:
        tell(f"gbid: error: crossval: {len(missed)} pairs below the minimum; the worst are listed")
    for line in causes_in_words(failed, code, _CODES):
        tell(f"gbid: {line}")
    if code:
        raise typer.Exit(code)
    if advice:
        tell(f"next: {advice}")


def _exit_code(failed: Sequence[Outcome], stuck: Sequence[Outcome], missed: Sequence[Mapping[str, Any]]) -> int:
    codes = [_CODES.get(o.cause, DataError.exit_code) for o in failed]
    codes += [NotConvergedError.exit_code] * bool(stuck) + [ThresholdError.exit_code] * bool(missed)
    return min(codes, default=0)


# ---- What a verb would make, without making it: `--dry-run`.

_COLUMNS = (Column("stage"), Column("to make", format="d"), Column("there", format="d"), Column("failed", format="d"))
_LATER = "what is to be made is known when the stages before have run"


def print_plan(experiment: Experiment, stages: Sequence[Stage], options: CommonOptions) -> None:
    """Print how many results of each stage are to be made, are there, and failed before; nothing is locked or written.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    rows = plan_rows(Job(experiment, options.overwrite, retry=options.retry), stages)
    if options.as_json:
        print_json({"experiment": experiment.spec.name, "results": experiment.results, "plan": rows})
        return
    unknown = [row["stage"] for row in rows if row["to_make"] is None]
    notes = [f"results: {experiment.results}", *([f"{', '.join(unknown)}: {_LATER}"] if unknown else [])]
    print_tables(Table("nothing is made: --dry-run", _COLUMNS, [list(row.values()) for row in rows], notes))


def plan_rows(job: Job, stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Return the counts of each stage that the experiment names; None where earlier stages have to run first."""
    rows: list[dict[str, Any]] = []
    pending = False
    for stage in stages:
        if not job.experiment.file.data.get(stage.section):
            continue
        if pending and not stage.early:
            rows.append({"stage": stage.name, "to_make": None, "there": None, "failed": None})
            continue
        work = stage.tasks(job)
        known = [standing(job, item) for item in work if isinstance(item, Task)]
        states = [outcome.state for outcome in known if outcome is not None]
        missing = known.count(None)
        failed = states.count("failed") + sum(not isinstance(item, Task) for item in work)
        rows.append({"stage": stage.name, "to_make": missing, "there": states.count("kept"), "failed": failed})
        pending = pending or missing > 0
    return rows


# ---- Work of a verb: the results folder is locked, stages run, their results are printed.


@contextmanager
def opened(experiment: Experiment, options: CommonOptions, **more: Any) -> Iterator[Job]:
    """Return a context that locks the results folder of an experiment and gives the job to run.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    options : CommonOptions
        Options of the verb.
    **more
        Further options of `gbid.experiment.campaign.working`.
    """
    print_notes(changed_files(experiment))
    more |= {"engine": options.engine, "workers": options.workers}
    with (
        reporting(options.quiet, options.verbose) as reporter,
        working(experiment, overwrite=options.overwrite, retry=options.retry, reporter=reporter, **more) as job,
    ):
        yield job


@contextmanager
def looked_at(experiment: Experiment, options: CommonOptions) -> Iterator[Job]:
    """Return a context that gives the job of a verb which shows results; it takes no lock."""
    remove_stale_parts(experiment.results)
    with reporting(options.quiet, options.verbose) as reporter:
        yield Job(experiment, options.overwrite, reporter)


def check_sections(experiment: Experiment, sections: Sequence[str], hint: str = "") -> None:
    """Refuse an experiment that has none of the sections, with further advice.

    Raises
    ------
    UsageError
        When it is so.
    """
    if not any(experiment.file.data.get(section) for section in sections):
        words = " or ".join(repr(section) for section in sections)
        raise UsageError(f"{experiment.file.path}: no section {words}; add one{hint}")


def run_stages(
    verb: str, path: Path, options: CommonOptions, names: Sequence[str], hint: str = "", only: str | None = None
) -> None:
    """Run stages and print their results; end with the exit code and the next step.

    Parameters
    ----------
    verb : str
        Name of the verb.
    path : pathlib.Path
        The experiment YAML; it must have the section of a stage, for `gbid fit` that of the fits.
    options : CommonOptions
        Options of the verb.
    names : sequence of str
        Names of the stages.
    hint : str
        Further advice when the YAML has none of the sections.
    only : str, optional
        The only fit to run.

    Raises
    ------
    UsageError
        When a section is missing, or when there is no such fit.
    """
    experiment, stages = options.load(path), [stage for stage in registry.STAGES if stage.name in names]
    if only is not None and experiment.spec.fits and only not in experiment.spec.fits:
        raise UsageError(f"--only {only}: no such fit; {nearest(only, experiment.spec.fits)}")
    sections = [FIT.section] if verb == "fit" else list(dict.fromkeys(stage.section for stage in stages))
    check_sections(experiment, sections, hint)
    if options.dry_run:
        print_plan(experiment, stages, options)
        return
    outcomes: list[Outcome] = []
    with opened(experiment, options) as job:
        for stage in stages:
            outcomes += run_tasks(job, fit_tasks(job, only)) if stage is FIT else run_stage(job, stage)
    document: dict[str, Any] = {}
    for stage in stages:
        document |= view_of(stage).document(job, outcomes)
    if options.as_json:
        print_json({**document, "outcomes": outcome_rows(outcomes)})
    else:
        for stage in stages:
            print_tables(*view_of(stage).tables(document))
    finish(outcomes, document.get("crossval", ()), "" if options.quiet else next_step(experiment, verb))
