"""Execution of verbs that run stages: plan, run, outcomes, exit code and next command."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import typer

from gbid.cli.options import STAGE_VERBS, CommonOptions
from gbid.cli.printing import print_json, print_notes, print_tables, tell, tell_error
from gbid.cli.progress import MANY, causes_in_words, reporting
from gbid.core.errors import DataError, GbidError, NotConvergedError, ThresholdError, UsageError, nearest
from gbid.core.index import load_index
from gbid.core.tables import Column, Table
from gbid.experiment.campaign import collect, read_shard, run_campaign, working
from gbid.experiment.experiment import Experiment, changed_files
from gbid.experiment.run import Job, Outcome, Stage, Task, has_section, no_tasks, run_stage, run_tasks, standing
from gbid.experiment.stages import registry
from gbid.experiment.stages.fit import FIT, fit_tasks
from gbid.report.campaign_tables import campaign_document, campaign_tables
from gbid.report.read import kept_report
from gbid.report.views import fit_rows, points_of, summary_lines, view_of

_LIKE = {
    **{"batch": "fit", "run": "report", "paper": "cycle"},
    **{"loop": "check", "prefilter": "import", "loop-cost": "static", "nominal": "crossval"},
}


def next_step(experiment: Experiment, verb: str) -> str:
    """Return the command that should follow a verb; empty after the last verb.

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
    verbs, done = ["check", *STAGE_VERBS, "report"], _LIKE.get(verb, verb)
    for later in verbs[verbs.index(done) + 1 :] if done in verbs else ():
        if later == "report" or has_section(experiment, STAGE_VERBS[later].section):
            return f"gbid {later} {path}"
    if done == "report" and any(has_section(experiment, section) for section in ("fits", "lpv", "controller")):
        return f"gbid export {path} --to {'c' if experiment.spec.controller else 'matlab'}"
    return ""


_MISSED = 20  # largest number of pairs below the minimum that are listed
_CODES = {"defect": GbidError.exit_code, "usage": UsageError.exit_code}


def outcome_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return outcomes as plain rows."""
    keys = ("state", "path", "converged", "text", "cause")
    return [
        {"stage": o.item.stage, "item": str(o.item), **{k: getattr(o, k) for k in keys}, "failed_before": o.before}
        for o in outcomes
    ]


def finish(outcomes: Sequence[Outcome], validated: Sequence[Mapping[str, Any]] = (), advice: str = "") -> None:
    """Print the failures on standard error and exit with the lowest applicable exit code, or 0.

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
    codes = [_CODES.get(o.cause, DataError.exit_code) for o in failed]
    codes += [NotConvergedError.exit_code] * bool(stuck) + [ThresholdError.exit_code] * bool(missed)
    code = min(codes, default=0)
    for o in stuck:
        tell_error(f"{o.item.stage} {o.item}: {o.text} (written to {o.path})")
    for row in sorted(missed, key=lambda row: row["fit_percent"])[:_MISSED]:
        pair = f"crossval {row['fit']}: model of {row['model']} on {row['recording']}: {row['output']}"
        below = f"{row['fit_percent']:.2f} %, below the minimum of {row['minimum_percent']:g} %"
        remedy = "look at its figures (`residuals: true`), or lower minimum_percent"
        tell_error(f"{pair} {below}; {remedy}")
    if len(missed) > _MISSED:
        tell_error(f"crossval: {len(missed)} pairs below the minimum; the worst are listed")
    for line in causes_in_words(failed, code, _CODES):
        tell_error(line, "")
    if code:
        raise typer.Exit(code)
    if advice:
        tell(f"next: {advice}")


_COLUMNS = (Column("stage"), Column("to make", format="d"), Column("there", format="d"), Column("failed", format="d"))
_LATER = "the items of this stage are known after the stages before it have run"


def print_plan(experiment: Experiment, stages: Sequence[Stage], options: CommonOptions) -> None:
    """Print the numbers of planned, existing and failed results of each stage, without locks or files.

    Raises
    ------
    UsageError
        When a result made from other settings exists and must not be replaced.
    """
    load_index(experiment.results)
    rows = plan_rows(Job(experiment, options.overwrite, retry=options.retry), stages)
    if options.as_json:
        print_json({"experiment": experiment.spec.name, "results": experiment.results, "plan": rows})
        return
    unknown = [row["stage"] for row in rows if row["to_make"] is None]
    notes = [f"results: {experiment.results}", *([f"{', '.join(unknown)}: {_LATER}"] if unknown else [])]
    print_tables(Table("nothing is made: --dry-run", _COLUMNS, [list(row.values()) for row in rows], notes))


def plan_rows(job: Job, stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Return the counts of each stage of the experiment; None if earlier stages must run first."""
    rows: list[dict[str, Any]] = []
    pending = False
    for stage in (stage for stage in stages if has_section(job.experiment, stage.section)):
        counts: list[int | None] = [None, None, None]
        if stage.early or not pending:
            work = stage.work(job)
            known = [standing(job, replace(i, read=None)) if isinstance(i, Task) else i for i in work]  # counts only
            states = ["missing" if outcome is None else outcome.state for outcome in known]
            counts = [states.count(state) for state in ("missing", "kept", "failed")]
            pending = pending or "missing" in states
        rows.append({"stage": stage.name, **dict(zip(("to_make", "there", "failed"), counts, strict=True))})
    return rows


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


def document_of(job: Job, stages: Sequence[Stage], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the JSON document of stages."""
    return {key: value for stage in stages for key, value in view_of(stage).document(job, outcomes).items()}


def tables_of(job: Job, stages: Sequence[Stage], outcomes: Sequence[Outcome]) -> Iterable[Table]:
    """Return the tables of stages, computed when they are printed."""
    return (table for stage in stages for table in view_of(stage).tables(job, outcomes))


def conclude(
    verb: str,
    experiment: Experiment,
    options: CommonOptions,
    outcomes: Sequence[Outcome],
    document: Mapping[str, Any],
    tables: Iterable[Table] = (),
    lines: Sequence[str] = (),
) -> None:
    """Print the results of a verb as JSON or as tables, then exit with its code and the next command."""
    if options.as_json:
        print_json({**document, "outcomes": outcome_rows(outcomes)})
    else:
        print_tables(*tables)
        if lines:
            typer.echo("\n".join(lines))
    advice = "" if options.quiet or not verb else next_step(experiment, verb)
    finish(outcomes, document.get("crossval", ()), advice)


def check_sections(experiment: Experiment, sections: Sequence[str], hint: str = "") -> None:
    """Refuse an experiment that has none of the given sections, with advice.

    Raises
    ------
    UsageError
        When it is so.
    """
    if not any(has_section(experiment, section) for section in sections):
        names = " or ".join(repr(section) for section in sections)
        raise UsageError(f"{experiment.file.path}: no section {names}; add one{hint}")


def stages_of(word: str) -> list[Stage]:
    """Return the stages for a word of `gbid run --only`: the stages of a verb, or a single stage.

    Raises
    ------
    UsageError
        When there is no such stage.
    """
    working_stages = [stage for stage in registry.STAGES if stage.tasks is not no_tasks]
    names = STAGE_VERBS[word].stages if word in STAGE_VERBS else (word.replace("-", " "),)
    stages = [stage for stage in working_stages if stage.name in names]
    if not stages:
        more = (stage.name.replace(" ", "-") for stage in working_stages)
        raise UsageError(f"{word}: no such stage; {nearest(word, dict.fromkeys([*STAGE_VERBS, *more]))}")
    return stages


def run_stages(word: str, path: Path, options: CommonOptions, *, only: str | None = None, before: bool = False) -> None:
    """Run the stages of a word and print their results; exit with their code and the next command.

    Parameters
    ----------
    word : str
        Name of a stage or of its verb, as `stages_of` takes it; the YAML must have the section of the stage, for
        ``fit`` that of the fits.
    path : pathlib.Path
        The experiment YAML.
    options : CommonOptions
        Options of the verb.
    only : str, optional
        The only fit to run.
    before : bool
        Whether the stages before it run, too, as far as `gbid run` runs them.

    Raises
    ------
    UsageError
        When there is no such stage or fit, or when the section is missing.
    """
    shown = stages_of(word)
    experiment = options.load(path)
    if only is not None and experiment.spec.fits and only not in experiment.spec.fits:
        raise UsageError(f"--only {only}: no such fit; {nearest(only, experiment.spec.fits)}")
    named = [stage.name for stage in shown]
    sections = [stage.section for stage in shown[named.index(word) if word in named else 0 :]]
    check_sections(experiment, sections, STAGE_VERBS[word].hint if word in STAGE_VERBS else "")
    last = registry.STAGES.index(shown[-1])
    earlier = [stage for stage in registry.STAGES[:last] if stage.in_run(experiment) and stage not in shown]
    stages = [stage for stage in registry.STAGES if stage in shown or (before and stage in earlier)]
    if options.dry_run:
        print_plan(experiment, stages, options)
        return
    whole_campaign = before and FIT in stages
    with opened(experiment, options) as job:
        outcomes = run_campaign(job) if whole_campaign else []
        for stage in stages:
            if stage is FIT and not whole_campaign:
                outcomes += run_tasks(job, fit_tasks(job, only))
            elif not (stage.early and whole_campaign):
                outcomes += run_stage(job, stage)
    document = document_of(job, stages, outcomes)
    conclude(word, experiment, options, outcomes, document, tables_of(job, shown, outcomes))


def run_one(path: Path, options: CommonOptions, item: str) -> None:
    """Compute one fit and its inputs while other processes may use the results folder; see `gbid.cli.verbs.fit`.

    Raises
    ------
    UsageError
        When there is no such fit, or an option is for many items.
    """
    if options.workers is not None or options.engine not in ("auto", "serial") or options.dry_run:
        raise UsageError("--one is one fit in this process; leave --engine, --workers and --dry-run out")
    experiment = options.load(path)
    with opened(experiment, replace(options, engine="serial"), shared=True) as job:
        outcomes = run_campaign(job, one=item)
    document = document_of(job, [FIT], outcomes)
    conclude("", experiment, options, outcomes, document, tables_of(job, [FIT], outcomes))


def list_items(path: Path, options: CommonOptions) -> None:
    """Print the item of each fit, with ``--json`` also its file; nothing is run or written."""
    tasks = fit_tasks(Job(options.load(path)))
    if options.as_json:
        print_json({"fits": [{"item": str(task.item), "path": task.path} for task in tasks]})
    else:
        typer.echo("\n".join(str(task.item) for task in tasks))


def run_batch(path: Path, options: CommonOptions, scheduler: str | None, shard: str | None, collected: bool) -> None:
    """Run a campaign or a shard of it, and print its table; see `gbid.cli.verbs.batch`.

    Raises
    ------
    UsageError
        When options contradict each other, or when there are no fits.
    """
    part = read_shard(shard) if shard is not None else None
    asks_for_work = options.retry or options.workers is not None or options.engine != "auto"
    if collected and (asks_for_work or part is not None or scheduler is not None):
        raise UsageError("--collect runs nothing; leave --shard, --retry, --engine, --workers and --scheduler out")
    experiment = options.load(path)
    check_sections(experiment, ["fits"])
    if options.dry_run:
        print_plan(experiment, [stage for stage in registry.STAGES if stage.early], options)
        return
    if scheduler is not None and not scheduler.startswith("tls:"):
        where = "has no encryption and no password: whoever reaches it can run code here and on its workers"
        tell(f"gbid: {scheduler} {where}; use it in a network that you trust")
    options = replace(options, engine="serial") if collected else options
    with opened(experiment, options, scheduler=scheduler, shared=part is not None) as job:
        outcomes = [] if collected else run_campaign(job, part)
        table, made = collect(job) if part is None else (None, [])
    outcomes += made
    document = campaign_document(experiment, outcomes, table)
    lines = [*(f"table: {path}" for path in document["table"]), f"results: {experiment.results}"]
    following = "" if part is not None else "batch"
    conclude(following, experiment, options, outcomes, document, campaign_tables(document), lines)


def run_all(path: Path, options: CommonOptions) -> None:
    """Run all stages of an experiment, draw its figures and write its report; see `gbid.cli.verbs.run`."""
    experiment = options.load(path)
    stages = [stage for stage in registry.STAGES if stage.in_run(experiment)]
    if options.dry_run:
        print_plan(experiment, stages, options)
        return

    with opened(experiment, options) as job:
        outcomes = run_campaign(job)
        table, collected = collect(job) if experiment.spec.fits else (None, [])
        outcomes += collected
        for stage in stages:
            outcomes += () if stage.early else run_stage(job, stage)
        drawn = _drawn(job) if experiment.spec.figures else []
        written = kept_report(job) or _written(job)
    outcomes += [*drawn, written]
    shown = [stage for stage in registry.STAGES if stage.name not in ("rig", "import", "figure")]
    many = [] if table is None or options.as_json or len(table) <= MANY else fit_rows(table)
    document = document_of(job, [stage for stage in shown if not (many and stage is FIT)], outcomes)
    document = {"fits": many, **document}
    tables = tables_of(job, shown, outcomes)
    if len(document["fits"]) > MANY:
        at = shown.index(FIT)
        campaign = campaign_tables(campaign_document(experiment, outcomes, table))
        tables = chain(tables_of(job, shown[:at], outcomes), campaign, tables_of(job, shown[at + 1 :], outcomes))
    figures = [str(outcome.path) for outcome in drawn if outcome.state != "failed"]
    page = None if written.state == "failed" else str(written.path)
    about = {"experiment": experiment.spec.name, "results": str(experiment.results), "figures": figures, "report": page}
    lines = [f"figure: {file}" for file in figures] if options.verbose else []
    lines += [*summary_lines(document, points_of(experiment)), f"results: {experiment.results}"]
    lines += [f"report: {page}"] if page else []
    conclude("run", experiment, options, outcomes, {**document, **about}, tables if options.verbose else (), lines)


def _drawn(job: Job) -> list[Outcome]:
    # half a second: what draws is imported when there is something to draw
    from gbid.report.pictures import draw_figures

    return draw_figures(job)


def _written(job: Job) -> Outcome:
    from gbid.report.write import write_report

    return write_report(job)
