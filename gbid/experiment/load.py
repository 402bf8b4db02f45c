"""Reading of an experiment YAML: first the form of each value, then the checks across sections."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gbid.errors import UsageError
from gbid.experiment.checks import find_experiment_problems
from gbid.experiment.experiment import Experiment
from gbid.experiment.problems import ExperimentError, Location, Problem, dotted, in_file_order, schema_text
from gbid.experiment.schema import ExperimentFile
from gbid.naming.paths import file_stem, given_path
from gbid.yaml_file import read_yaml


def load_experiment(path: str | Path, results: str | Path | None = None) -> Experiment:
    """Return the experiment of a file, after all checks that are possible before a run.

    Parameters
    ----------
    path : path
        The YAML.
    results : path, optional
        Folder of the results, instead of the folder that the file names.

    Returns
    -------
    Experiment
        The checked experiment.

    Raises
    ------
    ExperimentError
        With all problems at once, each with file, line, column, key and what to do.
    """
    path = given_path(path)
    try:
        file = read_yaml(path)
    except UsageError as error:
        position, _, text = str(error).partition(": ")
        raise ExperimentError([Problem(position, "", text)]) from None
    spec, faults = _parse(file.data)
    removed = [location for location, _ in faults]
    if faults:
        # The other values are checked as well, so that the user sees all problems at once.
        spec = _parse(_without(file.data, removed))[0]
    problems = [Problem(file.position(location), dotted(location), text) for location, text in faults]
    if spec is not None:
        folder = Path(results) if results else path.parent / (spec.results or f"results/{file_stem(spec.name)}")
        experiment = Experiment(file, spec, folder)
        found = find_experiment_problems(experiment)
        problems += [experiment.problem(place, text) for place, text in found if not _touches(place, removed)]
        if not problems:
            return experiment
    raise ExperimentError(in_file_order(problems))


def _parse(data: Any) -> tuple[ExperimentFile | None, list[tuple[Location, str]]]:
    """Return the parsed file, or the problems of its form: keys, types, ranges."""
    try:
        return ExperimentFile.model_validate(data), []
    except ValidationError as error:
        found = error.errors(include_url=False)
        # A list with faulty entries is reported by its entries; that pydantic then finds it too short is not reported.
        inside = {e["loc"][:-1] for e in found}
        return None, [
            schema_text(ExperimentFile, e) for e in found if not (e["type"] == "too_short" and e["loc"] in inside)
        ]


def _without(data: Any, locations: Sequence[Location]) -> Any:
    """Return a copy of the data without some values; None when a whole section would have to be removed."""
    data = deepcopy(data)
    for location in locations:
        node = data
        for key in location[:-1]:
            node = node[key]
        if not isinstance(node, dict) or isinstance(node.get(location[-1]), dict | list):
            return None
        node.pop(location[-1], None)
    return data


def _touches(location: Location, others: Sequence[Location]) -> bool:
    """Return whether a problem may come from a removed value: at the same key, or at one above or below it."""
    return any(location[: len(other)] == other[: len(location)] for other in others)
