"""Modules that are shipped beside the paper's experiment: its figures, tables and comparison."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from gbid.core.files import share_folder
from gbid.experiment.run import Job


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
