"""Text of a drafted experiment: commented YAML."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gbid.experiment.draft.draft_data import POINT, DraftData, DraftedFile, RunoutFound
from gbid.experiment.draft.draft_options import DraftOptions
from gbid.experiment.stages.importing.file_names import name_of
from gbid.lpv.surface_fit.terms import order_words, possible_order


def draft_text(name: str, target: Path, options: DraftOptions, data: DraftData, runout: RunoutFound) -> str:
    """Return the YAML of an experiment.

    Parameters
    ----------
    name : str
        Name of the experiment.
    target : pathlib.Path
        Folder that it will be written to.
    options : DraftOptions
        What was given.
    data : DraftData
        The files.
    runout : RunoutFound
        Harmonics of the run-out maps.
    """
    excited = [each for each in data.files if each.kind == "excited"]
    lines = [
        f"# Gas bearing with the recordings of {options.folder}, drafted by gbid new --from; change what you like.",
        "# gbid check experiment.yaml shows all problems, gbid run experiment.yaml does every step.",
        "format: 1",
        f"name: {name}",
        "",
        "import:",
        f"  data_folder: {_quoted(os.path.relpath(options.folder.resolve(), target.resolve()))}",
        *_files(options, data),
        "",
        *_prefilter(data, runout),
        "",
        *_models(excited, options),
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: object) -> str:
    return json.dumps(text, ensure_ascii=False)


def _mapping(each: DraftedFile, options: DraftOptions, data: DraftData, indent: str) -> list[str]:
    """Return clock, part and signals of a file."""
    survey = each.survey
    given = options.sample_time_s
    lines = [f"sample_time_s: {_seconds(given)}" if given else f"time: {_quoted(survey.roles.time)}"]
    why = "               # the speed changes outside" if options.from_s is None and options.to_s is None else ""
    for key in ("from_s", "to_s"):
        value = getattr(data, key)
        if value is not None:
            lines.append(f"{key}: {value:g}{why}")
    lines.append("signals:")
    for signal, columns in survey.roles.signals.items():
        names = "[" + ", ".join(_quoted(column) for column in columns) + "]"
        unit = f", unit: {_quoted(survey.units[signal])}" if signal in survey.units else ""
        remark = "   # the file states no unit" if unit else _MEANING[signal]
        lines.append(f"  {signal}: {{columns: {names}{unit}}}{remark}")
    return [indent + line for line in lines]


_MEANING = {
    "r": "   # references of the piezos, x and y",
    "u": "   # positions of the piezos",
    "p": "   # position of the disc",
    "phi": "   # shaft angle",
}


def _files(options: DraftOptions, data: DraftData) -> list[str]:
    """Return the files: those of the pattern in one section, the others one by one."""
    by_name = [q for q in data.files if data.names and data.names.pattern.read(q.survey.path.name) is not None]
    alone = [q for q in data.files if q not in by_name]
    lines = []
    if by_name and data.names:
        pattern = data.names.pattern
        lines += [
            "  folder:                      # all files whose names have one form",
            f"    pattern: {_quoted(pattern.text)}",
        ]
        if data.kinds:
            lines.append("    kinds: {" + ", ".join(f"{_quoted(w)}: {k}" for w, k in data.kinds.items()) + "}")
        fixed = {key: by_name[0].conditions[key] for key in POINT if key not in pattern.numbers}
        if fixed:
            lines.append("    conditions: {" + ", ".join(f"{key}: {value!r}" for key, value in fixed.items()) + "}")
        lines += _mapping(by_name[0], options, data, "    ")
    if alone:
        lines.append("  recordings:" + ("                  # files of another kind" if by_name else ""))
    for each in alone:
        point = ", ".join(f"{key}: {value!r}" for key, value in each.conditions.items())
        same = [
            q for q in data.files if q is not each and name_of(q.survey.path.stem) == name_of(each.survey.path.stem)
        ]
        stem = each.survey.path.stem + (each.survey.path.suffix if same else "")
        lines += [
            f"    - name: {name_of(stem)}",
            f"      file: {_quoted(each.survey.path.name)}",
            f"      kind: {each.kind}",
            f"      conditions: {{{point}}}",
            *_mapping(each, options, data, "      "),
        ]
    return lines


def _prefilter(data: DraftData, runout: RunoutFound) -> list[str]:
    points = {
        kind: {tuple(q.conditions.values()) for q in data.files if q.kind == kind} for kind in ("excited", "stationary")
    }
    without_angle = any("phi" not in q.recording.signals for q in data.files)
    if without_angle or points["excited"] - points["stationary"]:
        return [
            "prefilter:                     # not every operating point has a stationary run with the shaft angle,",
            "  method: none                 # so that run-out stays in the signals; means and spikes are removed",
        ]
    lines = ["prefilter:                     # run-out over the shaft angle; on held-out data:"]
    lines += [f"  # {words}" for words in runout.words]
    return [*lines, f"  harmonics: {runout.harmonics or 10}"]


def _models(excited: Sequence[DraftedFile], options: DraftOptions) -> list[str]:
    lines = ["fits:", "  bearing: {structure: rotor_bearing}   # piezo positions u to disc position p"]
    with_reference = all("r" in each.recording.signals for each in excited)
    points = np.array([[each.conditions[key] for key in POINT] for each in excited])
    if with_reference:
        lines.append("  piezos: {structure: piezo_pair}       # references r to piezo positions u")
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    validated = ["  bearing: {on: cyclic}"] if counts.min() > 1 else []
    validated += ["  piezos: {on: others}"] if with_reference and len(excited) > 1 else []
    if validated:
        lines += ["", "crossval:                      # models on recordings that they were not fitted to", *validated]
    if not with_reference:
        return [
            *lines,
            "",
            "# Without the references r there is no model of the piezos, so no surfaces and no controller.",
        ]
    time = excited[0].recording.sample_time
    return [
        *lines,
        "",
        "nominal: {fit: piezos}         # the most central model of the piezos stands for all",
        "",
        f"lpv:                           # surfaces over pressure and speed, {len(distinct)} operating points",
        "  fit: bearing",
        f"  order: {order_words(possible_order(points))}",
        "  actuators: nominal",
        "",
        "controller:",
        f"  feedback: {{structure: {options.controller}, peak_sensitivity: 2.6, design_for: sampled, "
        f"sample_time_s: {_seconds(time)}}}",
    ]


def _seconds(value: float) -> str:
    """Return a time with a decimal point, as YAML needs it for a number."""
    text = f"{value:.6g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"
