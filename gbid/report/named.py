"""Modules shipped beside the paper's experiment: figures, tables and comparison of the paper."""

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
    """Return the shipped module with the tables of the paper."""
    return _shipped("theisen2016_paper")


def comparison() -> ModuleType:
    """Return the shipped module that compares figures and statements of the paper with results."""
    return _shipped("theisen2016_comparison")


def write_shipped(job: Job, part: Path, *, module: str, function: str, **options: Any) -> None:
    """Write a result by a function of a shipped module; a worker process imports the module again."""
    getattr(_shipped(module), function)(job, part, **options)


@cache
def _shipped(name: str) -> ModuleType:
    """Import a module from the folder of experiments; it may import its neighbours."""
    folder = str(share_folder("experiments"))
    sys.path.insert(0, folder)
    try:
        return import_module(name)
    finally:
        sys.path.remove(folder)
