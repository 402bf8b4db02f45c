"""Options and arguments that several verbs have in common, stages as words, and the overview of `gbid --help`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from glob import escape
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer
from typer.core import TyperGroup

from gbid.cli.guard import guarded

if TYPE_CHECKING:
    from gbid.experiment.experiment import Experiment


def files_ending(*endings: str) -> Callable[[str], list[str]]:
    """Return a shell completion function for folders and files with given endings."""

    def complete(incomplete: str) -> list[str]:
        written, slash, begun = incomplete.rpartition("/")
        paths = sorted(Path(written + slash).expanduser().glob(f"{escape(begun)}*"))
        shown = [path for path in paths if begun.startswith(".") or not path.name.startswith(".")]
        offered = [(path.name, path.is_dir()) for path in shown if path.is_dir() or path.suffix in endings]
        return [f"{written}{slash}{name}{'/' * folder}" for name, folder in offered]

    return complete


complete_experiment = files_ending(".yaml", ".yml")
complete_source = files_ending(".yaml", ".yml", ".h5")


_EXPERIMENT: Any = {"metavar": "EXPERIMENT", "help": "The experiment YAML.", "show_default": False}
ExperimentPath = Annotated[Path, typer.Argument(autocompletion=complete_experiment, **_EXPERIMENT)]
MeasuredFolder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="The folder with the files of a logger.", show_default=False)
]


def drafted_folder(measured: Path, folder: Path | None) -> Path:
    """Return the folder of the experiment for a folder of recordings; by default FOLDER-experiment, here."""
    return folder or Path(f"{measured.resolve().name}-experiment")


@dataclass(frozen=True)
class CommonOptions:
    """Common options of the verbs; options that a verb does not have keep their defaults."""

    results: Annotated[
        Path | None,
        typer.Option("--results", metavar="DIR", help="Folder of the results, instead of the one in the YAML."),
    ] = None
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Another value for a key of the YAML, in this command only; repeatable."
        ),
    ] = None
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that were made with other settings or data.")
    ] = False
    engine: Annotated[
        str,
        typer.Option(
            "--engine",
            metavar="NAME",
            help="What runs the items: serial (this process), pool (processes), dask, or auto (a pool for many).",
        ),
    ] = "auto"
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", help="Number of processes; all processors when not given.")
    ] = None
    retry: Annotated[bool, typer.Option("--retry", help="Try failed items with the same settings and data again.")] = (
        False
    )
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no advice; errors are told.")] = False
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="A line for each item and each iteration, and all tables.")
    ] = False
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output, in SI units.")] = False
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False

    def load(self, path: Path, *, form_only: bool = False) -> Experiment:
        """Return the experiment of a YAML file, with the given results folder; see `load_experiment`."""
        from gbid.cli.printing import tell_line
        from gbid.experiment.load import load_experiment

        return load_experiment(path, self.results, changes=self.changes or (), announce=tell_line, form_only=form_only)


COMMON = tuple(field.name for field in fields(CommonOptions))


def with_options(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that adds common options to a command: the named options, or all if no name is given.

    The verb receives them as one value, ``options``; its errors become messages and exit codes.
    """

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        @wraps(verb)
        def command(**given: Any) -> None:
            options = CommonOptions(**{name: given.pop(name) for name in names or COMMON})
            with guarded(options.as_json, options.debug):
                verb(**given, options=options)

        hints = get_type_hints(CommonOptions, include_extras=True)
        parameters = [p for p in signature(verb, eval_str=True).parameters.values() if p.name != "options"]
        parameters += [
            Parameter(field.name, Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name])
            for field in fields(CommonOptions)
            if field.name in (names or COMMON)
        ]
        command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # typer reads it
        return command

    return decorate


# ---- Stages as words of the command line.

OR_RUN = ", or use `gbid run`"
"""What a verb that makes recordings advises when the YAML has no such section."""


class StageVerb(NamedTuple):
    """Verb that runs one or several stages; also a word for `gbid run --only`.

    Attributes
    ----------
    section : str
        Key of its section in the YAML.
    stages : tuple of str
        Names of its stages in `gbid.experiment.stages.registry`.
    help : str
        Help text of the verb.
    hint : str
        Further advice when the YAML has no such section.
    """

    section: str
    stages: tuple[str, ...]
    help: str
    hint: str = ""


STAGE_VERBS: dict[str, StageVerb] = {
    "rig": StageVerb(
        "rig",
        ("loop", "rig"),
        "Make the recordings of the rig section, after the designs that close their loops.",
        OR_RUN,
    ),
    "import": StageVerb("import", ("import",), "Read the recordings of the import section.", OR_RUN),
    "fit": StageVerb("fits", ("prefilter", "fit"), "Prefilter the recordings, if the YAML says so, and run the fits."),
    "static": StageVerb(
        "static",
        ("static",),
        "Characterise staircases: static gains of the bearing, hysteresis and creep of the piezos.",
    ),
    "crossval": StageVerb(
        "crossval",
        ("crossval", "nominal"),
        "Validate the fitted models and choose the nominal actuator; exit code 5 when a minimum fit is missed.",
    ),
    "lpv": StageVerb(
        "lpv", ("lpv",), "Fit surfaces over pressure and speed to the fits, and show the deviations of the recordings."
    ),
    "excite": StageVerb(
        "excite",
        ("excite",),
        "Design the excitation of the next recordings from the fits: a CSV file for the signal generator.",
    ),
    "tune": StageVerb(
        "controller",
        ("tune",),
        "Tune controllers: the gains with the most damping within limits, compared with the published ones.",
    ),
    "impact": StageVerb(
        "impacts",
        ("impact",),
        "Hit the rig with a hammer, open and closed loop: identified and expected modes, force scaling, fit.",
    ),
    "cycle": StageVerb(
        "cycle",
        ("cycle",),
        "Record with the tuned controller in the loop, fit and tune again, and measure each round by impacts.",
    ),
}
"""Verbs of the stages in the order of a run; the names are read before the stages are imported, for a fast help."""


# ---- Overview of `gbid --help`: verbs in groups, and examples to copy.

START, RESULTS, HELP, STAGES = "Start", "Results", "Help", "Stages"
GROUPS = (START, RESULTS, HELP, STAGES)
"""Groups in the order of the work; a verb names its group as `rich_help_panel`."""


class GroupedCommands(TyperGroup):
    """Command group that lists the verbs by group, each with its full first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the groups in their order; verbs without a group come last."""
        rows: dict[str, list[tuple[str, str]]] = {group: [] for group in GROUPS}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                group = getattr(command, "rich_help_panel", None)
                group = group if isinstance(group, str) else "Other"
                rows.setdefault(group, []).append((name, command.get_short_help_str(200)))
        width = max(len(name) for group in rows.values() for name, _ in group)
        for group, lines in rows.items():
            if lines:
                with formatter.section(group):
                    formatter.write_dl([(f"{name:{width}}", text) for name, text in lines])


def examples(*lines: str) -> str:
    """Return an epilog with command lines, one per line."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])
