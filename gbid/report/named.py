"""Figures by name: each file of this package lists its own, and `gbid paper`, the page and the docs find them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType
from typing import Any

from matplotlib.figure import Figure

from gbid.core.files import share_folder
from gbid.experiment.run import Job
from gbid.report.canvas import Drawn, figure_of
from gbid.report.read import Results


@dataclass(frozen=True)
class NamedFigure:
    """A figure that is drawn from the results of an experiment.

    A module of this package that has figures gives them as the tuple ``FIGURES``; nothing else has to know of them.

    Attributes
    ----------
    name : str
        Of its files: number in the paper, or what it shows.
    draw : callable
        Draws it from `Results` and returns what a picture function returns; `DataError` where a result is missing.
    words : str
        What a reader who cannot see it should know; for the page.
    section : str
        Section of the page in which it stands, by id, as ``"surfaces"``; empty when the page does not show it.
    """

    name: str
    draw: Callable[[Results], Drawn]
    words: str = ""
    section: str = ""

    def make(self, results: Results) -> Figure:
        """Draw the figure.

        Raises
        ------
        DataError, UsageError
            When the results do not allow it, with the reason.
        """
        return figure_of(self.draw(results))


def paper() -> ModuleType:
    """Return the module with the tables of the paper, which is shipped beside its experiment."""
    return _shipped("theisen2016_paper")


def comparison() -> ModuleType:
    """Return the module that compares the figures and sentences of the paper with results."""
    return _shipped("theisen2016_comparison")


def write_shipped(job: Job, part: Path, *, module: str, function: str, **options: Any) -> None:
    """Write a result by a function of a shipped module, which a worker process loads anew."""
    getattr(_shipped(module), function)(job, part, **options)


@cache
def _shipped(name: str) -> ModuleType:
    """Import a module of the folder of experiments, and those of the folder that it imports."""
    folder = str(share_folder("experiments"))
    sys.path.insert(0, folder)
    try:
        return import_module(name)
    finally:
        sys.path.remove(folder)


def named_figures() -> dict[str, NamedFigure]:
    """Find the figures that the modules of this package list, by name in alphabetical order."""
    from gbid import report

    modules = walk_packages(report.__path__, f"{report.__name__}.")
    listed = [figure for module in modules for figure in getattr(import_module(module.name), "FIGURES", ())]
    return {figure.name: figure for figure in sorted(listed, key=lambda figure: figure.name)}
