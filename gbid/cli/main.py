"""Command `gbid`. Verbs import their modules when they are called, so that help appears at once."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from copy import copy
from typing import Annotated

import typer

from gbid._version import __version__
from gbid.cli.about import bench, check, doctor, explain, schema
from gbid.cli.files import clean, export, init, new, peek
from gbid.cli.options import HELP, RESULTS, STAGE_VERBS, STAGES, START, GroupedCommands, examples
from gbid.cli.results import compare, diff, show
from gbid.cli.verbs import batch, fit, open_folder, paper, report, run, serve, stage_verb

_STAGES = {name: fit if name == "fit" else stage_verb(name) for name in STAGE_VERBS}  # `fit` has options of its own
VERBS: dict[str, dict[str, Callable[..., None]]] = {
    START: {
        "open": open_folder,
        **{"init": init, "new": new, "peek": peek, "check": check, "run": run, "tune": _STAGES["tune"]},
    },
    RESULTS: {
        "show": show,
        "diff": diff,
        "compare": compare,
        "report": report,
        "serve": serve,
        "export": export,
        "paper": paper,
    },
    HELP: {"explain": explain, "doctor": doctor, "clean": clean},
    STAGES: {"batch": batch, "fit": fit},
}
"""Verbs by group, in the order of the overview."""
HIDDEN: dict[str, Callable[..., None]] = {
    **{name: verb for name, verb in _STAGES.items() if name not in ("fit", "tune")},
    **{"schema": schema, "bench": bench},
}
"""Verbs that the overview leaves out: those of the stages are `gbid run --only STAGE` by another name."""

EXAMPLES = """\
gbid init measured
gbid init measured rig3 --speed 6000
gbid open measured --browser
gbid open measured rig3 --port 0
gbid new rig1
gbid new --list
gbid new rig2 --template own-recordings
gbid init measured rig3 --moving-mass 2.4 --travel 45 --clearance 25
gbid check rig1/experiment.yaml
gbid run rig1/experiment.yaml
gbid run rig1/experiment.yaml --json > results.json
gbid run rig1/experiment.yaml --until fit
gbid run rig1/experiment.yaml --only tune --overwrite
gbid run rig1/experiment.yaml --set controller.feedback.structure=biquad
gbid show rig1/results/quickstart/fits/bearing/p6_n0_prbs1.h5
gbid show rig1/results/quickstart/fits/bearing/p6_n0_prbs1.h5 --json
gbid diff rig1/results/quickstart rig2/results/quickstart
gbid diff rig1/results/quickstart rig2/results/quickstart --json
gbid compare fits/a/run1.h5 fits/b/run1.h5 --on recordings/run2.h5
gbid compare fits/a/run1.h5 --plain recordings/run1.h5 --on recordings/run2.h5 --output models.html
gbid compare fits/a/run1.h5 --on recordings/run2.h5 --json
gbid peek measured/run_07.tdms
gbid peek measured/run_07.csv --decimal ,
gbid clean rig1/experiment.yaml --dry-run
gbid clean rig1/experiment.yaml --everything
gbid doctor
gbid doctor --json
gbid schema --output rig1/experiment.schema.json
gbid import rig2/experiment.yaml
gbid rig rig1/experiment.yaml --overwrite
gbid fit rig1/experiment.yaml --only bearing
gbid fit rig1/experiment.yaml --one bearing/p6_n0_prbs1   # one file, for Snakemake or an array of jobs
gbid batch rig1/experiment.yaml                     # all processors; again to resume
gbid batch rig1/experiment.yaml --shard 3/8         # a job of an array
gbid batch rig1/experiment.yaml --scheduler tcp://node1:8786
gbid static rig1/experiment.yaml --json
gbid lpv rig1/experiment.yaml
gbid lpv rig1/experiment.yaml --json
gbid crossval rig1/experiment.yaml
gbid excite rig1/experiment.yaml
gbid excite rig1/experiment.yaml --json
gbid tune rig1/experiment.yaml
gbid tune rig1/experiment.yaml --json > designs.json
gbid impact rig1/experiment.yaml
gbid impact rig1/experiment.yaml --json > impacts.json
gbid cycle rig1/experiment.yaml
gbid cycle rig1/experiment.yaml --json > cycle.json
gbid explain GB102
gbid explain
gbid paper theisen2016.yaml
gbid paper theisen2016.yaml --only figures --format png
gbid paper theisen2016.yaml --only comparison --json > reproduction.json
gbid bench
gbid bench --samples 100000
gbid export rig1/experiment.yaml --to matlab   # all its models and controllers, for MATLAB
gbid export rig1/experiment.yaml --to c        # its controllers as C source
gbid export theisen2016 --to csv --at 6 0      # a model at 6 bar and 0 rpm
gbid report rig1/experiment.yaml
gbid report rig1/experiment.yaml --output report.html
gbid report rig1/experiment.yaml --curves           # curves of all fits, beside the page
gbid serve rig1/experiment.yaml --browser
gbid serve rig1/experiment.yaml --port 0
"""
"""Command lines that the help of each verb shows."""

app = typer.Typer(
    name="gbid",
    cls=GroupedCommands,
    help="Grey-box identification of rotors on controllable gas bearings, from an experiment YAML.",
    epilog=examples(
        "gbid new rig1                     # an experiment that runs as it is",
        "gbid run rig1/experiment.yaml     # every stage that it names",
        "gbid run --help                   # options and examples of a verb",
        "gbid crossval rig1/experiment.yaml   # each stage is a verb, too: gbid run --only crossval",
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


for _group, _verbs in {**VERBS, "": HIDDEN}.items():
    for _name, _verb in _verbs.items():
        _lines = (line for line in EXAMPLES.splitlines() if line.split()[1] == _name)
        app.command(_name, rich_help_panel=_group, epilog=examples(*_lines), hidden=_name in HIDDEN)(_verb)


def main() -> None:
    """Run the command line; exit codes are defined in `gbid.core.errors`."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small, and a process without threads can fork
    gc.set_threshold(200_000)  # most of what the imports make stays: to look for garbage in it is a tenth of a start
    named = [verb for verb in app.registered_commands if verb.name in sys.argv[1:2]]
    called = copy(app)
    called.registered_commands = named or app.registered_commands  # to make all verbs is a twentieth of a start
    try:
        called(prog_name="gbid")
    except KeyboardInterrupt:  # outside of a verb: while the command line is read
        sys.exit(130)
    finally:
        gc.freeze()  # else Python looks for garbage once more at its end: a quarter of the time of a short verb
        # An interruption within code that is executed from text, as where a dataclass is made, leaves a mark by which
        # Python ends as killed by SIGINT although the interruption was handled. The next code from text removes it.
        exec("")


if __name__ == "__main__":
    main()
