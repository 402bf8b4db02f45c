"""Command `gbid`. Verbs import their modules when they are called, so that help appears at once."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from gbid._version import __version__
from gbid.cli.about import check, doctor, explain, schema
from gbid.cli.files import clean, export, import_recordings, new
from gbid.cli.options import DATA, IDENTIFY, REPORT, START, GroupedCommands, examples
from gbid.cli.results import figures, report, reproduce, serve
from gbid.cli.verbs import STAGE_VERBS, batch, command_of, fit, run

app = typer.Typer(
    name="gbid",
    cls=GroupedCommands,
    help="Grey-box identification of rotors on controllable gas bearings, from an experiment YAML.",
    epilog=examples(
        "gbid new rig1                     # an experiment that runs as it is",
        "gbid run rig1/experiment.yaml     # every stage that it names",
        "gbid fit --help                   # options and examples of a verb",
    ),
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gbid {__version__}")
        raise typer.Exit


@app.callback()
def _gbid(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


app.command(
    "new",
    rich_help_panel=START,
    epilog=examples(
        "gbid new rig1", "gbid new --list", "gbid new rig2 --template own-recordings", "gbid new rig3 --from measured"
    ),
)(new)
app.command("check", rich_help_panel=START, epilog=examples("gbid check rig1/experiment.yaml"))(check)
app.command(
    "run",
    rich_help_panel=START,
    epilog=examples("gbid run rig1/experiment.yaml", "gbid run rig1/experiment.yaml --json > results.json"),
)(run)
app.command(
    "clean",
    rich_help_panel=START,
    epilog=examples("gbid clean rig1/experiment.yaml --dry-run", "gbid clean rig1/experiment.yaml --everything"),
)(clean)
app.command("doctor", rich_help_panel=START, epilog=examples("gbid doctor", "gbid doctor --json"))(doctor)
app.command("explain", rich_help_panel=REPORT, epilog=examples("gbid explain GB102", "gbid explain"))(explain)
app.command("schema", rich_help_panel=START, epilog=examples("gbid schema --output rig1/experiment.schema.json"))(
    schema
)
app.command(
    "import",
    rich_help_panel=DATA,
    epilog=examples("gbid import rig2/experiment.yaml", "gbid import --peek measured/run_07.tdms"),
)(import_recordings)
app.command("fit", rich_help_panel=IDENTIFY, epilog=examples("gbid fit rig1/experiment.yaml --only bearing"))(fit)
app.command(
    "batch",
    rich_help_panel=IDENTIFY,
    epilog=examples(
        "gbid batch rig1/experiment.yaml                     # all processors; again to resume",
        "gbid batch rig1/experiment.yaml --shard 3/8         # a job of an array",
        "gbid batch rig1/experiment.yaml --scheduler tcp://node1:8786",
    ),
)(batch)
for _verb in STAGE_VERBS:
    app.command(_verb.name, rich_help_panel=_verb.group, epilog=examples(*_verb.examples))(command_of(_verb))
app.command("figures", rich_help_panel=REPORT, epilog=examples("gbid figures theisen2016.yaml --overwrite"))(figures)
app.command(
    "reproduce",
    rich_help_panel=REPORT,
    epilog=examples("gbid reproduce theisen2016.yaml", "gbid reproduce theisen2016.yaml --json > reproduction.json"),
)(reproduce)
app.command(
    "export",
    rich_help_panel=REPORT,
    epilog=examples(
        "gbid export rig1/experiment.yaml --to matlab   # all its models and controllers, for MATLAB",
        "gbid export rig1/experiment.yaml --to c        # its controllers as C source",
        "gbid export theisen2016 --to csv --at 6 0      # a model at 6 bar and 0 rpm",
    ),
)(export)
app.command(
    "report",
    rich_help_panel=REPORT,
    epilog=examples("gbid report rig1/experiment.yaml", "gbid report rig1/experiment.yaml --output report.html"),
)(report)
app.command(
    "serve",
    rich_help_panel=REPORT,
    epilog=examples("gbid serve rig1/experiment.yaml --browser", "gbid serve rig1/experiment.yaml --port 0"),
)(serve)


def main() -> None:
    """Run the command line; the exit codes are those of `gbid.core.errors`."""
    try:
        app(prog_name="gbid")
    except KeyboardInterrupt:  # outside of a verb: while the command line is read
        sys.exit(130)
    finally:
        # An interruption within code that is executed from text, as where a dataclass is made, leaves a mark by which
        # Python ends as killed by SIGINT although the interruption was handled. The next code from text removes it.
        exec("")


if __name__ == "__main__":
    main()
