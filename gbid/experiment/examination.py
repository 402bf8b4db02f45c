"""Examination of this machine: compiler, cache, versions, disk and threads."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from enum import Enum
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from re import match
from typing import Any

from threadpoolctl import threadpool_info  # type: ignore[import-untyped]

from gbid._version import __version__
from gbid.core.compiled import CompilerMissingError, cache_folder, find_compiler, load_library, why_not_trusted
from gbid.core.tables import file_size

_TRIAL = "int gbid_trial(void) { return 7; }\n"
_OF_DEVELOPERS = ("extra == 'test'", "extra == 'docs'")
_LITTLE = 1e9  # free space below which a campaign may not fit [bytes]


class Verdict(Enum):
    """Assessment of a finding: good, good with a note, or bad."""

    GOOD = "good"
    NOTE = "note"
    BAD = "bad"


@dataclass(frozen=True)
class Finding:
    """Result of one check of this machine.

    Attributes
    ----------
    what : str
        The thing.
    verdict : Verdict
        ``NOTE`` where gbid does without it.
    found : str
        What there is.
    remedy : str
        What to do; empty when nothing is needed.
    """

    what: str
    verdict: Verdict
    found: str
    remedy: str = ""

    def document(self) -> dict[str, Any]:
        """Return the finding as plain values."""
        return {**asdict(self), "verdict": self.verdict.value}


def examine() -> list[Finding]:
    """Return the findings on versions, compiler, cache of kernels, disk and threads."""
    return [*_versions(), _compiler(), _cache(), *_disks(), *_threads()]


def _versions() -> Iterator[Finding]:
    yield Finding("gbid", Verdict.GOOD, f"{__version__} in {Path(__file__).parents[1]}")
    yield Finding("python", Verdict.GOOD, f"{platform.python_version()} on {platform.platform()}, {sys.executable}")
    versions: dict[bool, dict[str, str]] = {False: {}, True: {}}  # of what gbid needs, and of extras
    for requirement in requires("gbid") or ():
        name = match(r"[A-Za-z0-9._-]+", requirement)
        if name and not requirement.endswith(_OF_DEVELOPERS):
            versions["extra ==" in requirement][name[0]] = _version(name[0])
    needed, extras = (
        ", ".join(f"{name} {version}" for name, version in group.items() if version) for group in versions.values()
    )
    missing = ", ".join(name for name, version in versions[False].items() if not version)
    remedy = f"{missing} missing; install gbid anew with pip" if missing else ""
    yield Finding("packages", Verdict.BAD if missing else Verdict.GOOD, needed, remedy)
    yield Finding("optional packages", Verdict.GOOD, extras or "none")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _compiler() -> Finding:
    try:
        compiler = find_compiler()
    except CompilerMissingError as error:
        remedy = "fits run with the portable pass, ten times as slow; install gcc, clang or gbid[compiler], or set CC"
        return Finding("C compiler", Verdict.NOTE, str(error), remedy)
    first = next(iter(compiler.version.splitlines()), "")
    return Finding("C compiler", Verdict.GOOD, f"{' '.join(compiler.command)}: {first}")


def _cache() -> Finding:
    folder = cache_folder()
    try:
        library = load_library(_TRIAL)
        works = library.gbid_trial() == 7
    except (CompilerMissingError, OSError, AttributeError) as error:
        return Finding("compiled kernels", Verdict.NOTE, str(folder), str(error))
    kernels = [path.stat().st_size for path in folder.glob("*.so")]
    text = f"{folder}: {len(kernels)} kernels, {file_size(sum(kernels))}"
    if not works:
        return Finding("compiled kernels", Verdict.BAD, text, "a compiled function is wrong: `gbid clean --kernels`")
    remedy = f"{why_not_trusted(folder) or library.note}: chmod go-w it, or set GBID_CACHE_DIR" if library.note else ""
    return Finding("compiled kernels", Verdict.NOTE if remedy else Verdict.GOOD, text, remedy)


def _disks() -> Iterator[Finding]:
    for what, folder in (("this folder", Path()), ("temporary files", Path(tempfile.gettempdir()))):
        free, remedy = shutil.disk_usage(folder).free, ""
        if not os.access(folder, os.W_OK):
            remedy = "cannot be written; results can go elsewhere with --results"
        elif free < _LITTLE:
            remedy = "little free space; `gbid check` says how much an experiment needs"
        text = f"{folder.resolve()}: {file_size(free)} free"
        yield Finding(what, Verdict.NOTE if remedy else Verdict.GOOD, text, remedy)


def _threads() -> Iterator[Finding]:
    affinity = getattr(os, "sched_getaffinity", None)
    usable = len(affinity(0)) if affinity else os.cpu_count() or 1
    yield Finding("processors", Verdict.GOOD, f"{usable} of {os.cpu_count()} usable: workers of `gbid batch`")
    import numpy as np

    np.ones((2, 2)) @ np.ones((2, 2))
    libraries = [f"{lib['internal_api']} with {lib['num_threads']}" for lib in threadpool_info()]
    text = f"{', '.join(libraries) or 'none found'} threads; fits use one each"
    yield Finding("BLAS", Verdict.GOOD, text)
