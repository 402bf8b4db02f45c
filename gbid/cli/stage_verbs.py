"""Verbs that run the stages of one section and print their results: `gbid rig`, `gbid tune` and so on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gbid.cli.groups import CONTROL, DATA, IDENTIFY
from gbid.cli.guard import guarded
from gbid.cli.options import (
    AsJson,
    Debug,
    DryRun,
    Engine,
    ExperimentPath,
    Overwrite,
    Quiet,
    Results,
    Retry,
    Verbose,
    Workers,
)


@dataclass(frozen=True)
class StageVerb:
    """Verb that runs stages.

    Attributes
    ----------
    name, group, help : str
        Name, group in the overview, and help text.
    stages : tuple of str
        Names of the stages.
    examples : tuple of str
        Command lines.
    hint : str
        Further advice when the YAML has none of the sections.
    """

    name: str
    group: str
    help: str
    stages: tuple[str, ...]
    examples: tuple[str, ...]
    hint: str = ""


OR_RUN = ", or use `gbid run`"
"""What a verb that makes recordings advises when the YAML has no such section."""

STAGE_VERBS = (
    StageVerb(
        "rig",
        DATA,
        "Make the recordings of the rig section, after the designs that close their loops.",
        ("loop", "rig"),
        ("gbid rig rig1/experiment.yaml --overwrite",),
        OR_RUN,
    ),
    StageVerb(
        "static",
        IDENTIFY,
        "Characterise staircases: static gains of the bearing, hysteresis and creep of the piezos.",
        ("static",),
        ("gbid static rig1/experiment.yaml --json",),
    ),
    StageVerb(
        "lpv",
        IDENTIFY,
        "Fit surfaces over pressure and speed to the fits, and show the deviations of the recordings.",
        ("lpv",),
        ("gbid lpv rig1/experiment.yaml", "gbid lpv rig1/experiment.yaml --json"),
    ),
    StageVerb(
        "crossval",
        IDENTIFY,
        "Validate the fitted models and choose the nominal actuator; exit code 5 when a minimum fit is missed.",
        ("crossval", "nominal"),
        ("gbid crossval rig1/experiment.yaml",),
    ),
    StageVerb(
        "excite",
        IDENTIFY,
        "Design the excitation of the next recordings from the fits: a CSV file for the signal generator.",
        ("excite",),
        ("gbid excite rig1/experiment.yaml", "gbid excite rig1/experiment.yaml --json"),
    ),
    StageVerb(
        "tune",
        CONTROL,
        "Tune controllers: the gains with the most damping within limits, compared with the published ones.",
        ("tune",),
        ("gbid tune rig1/experiment.yaml", "gbid tune rig1/experiment.yaml --json > designs.json"),
    ),
    StageVerb(
        "impact",
        CONTROL,
        "Hit the rig with a hammer, open and closed loop: identified and expected modes, force scaling, fit.",
        ("impact",),
        ("gbid impact rig1/experiment.yaml", "gbid impact rig1/experiment.yaml --json > impacts.json"),
    ),
    StageVerb(
        "cycle",
        CONTROL,
        "Record with the tuned controller in the loop, fit and tune again, and measure each round by impacts.",
        ("cycle",),
        ("gbid cycle rig1/experiment.yaml", "gbid cycle rig1/experiment.yaml --json > cycle.json"),
    ),
)


def command_of(verb: StageVerb) -> Callable[..., None]:
    """Return the function of a verb for typer."""

    def command(
        experiment: ExperimentPath,
        results: Results = None,
        overwrite: Overwrite = False,
        engine: Engine = "auto",
        workers: Workers = None,
        retry: Retry = False,
        dry_run: DryRun = False,
        quiet: Quiet = False,
        verbose: Verbose = False,
        as_json: AsJson = False,
        debug: Debug = False,
    ) -> None:
        with guarded(as_json, debug):
            from gbid.cli.manner import Manner
            from gbid.cli.stages import run_stages

            run_stages(
                verb.stages,
                experiment,
                results,
                Manner(verb.name, as_json, quiet, verbose, dry_run),
                verb.hint,
                overwrite=overwrite,
                engine=engine,
                workers=workers,
                retry=retry,
            )

    command.__doc__ = verb.help
    return command
