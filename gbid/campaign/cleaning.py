"""Files that a results folder can do without."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from gbid.atomic import find_stale_parts
from gbid.errors import DataError
from gbid.experiment.keys import stored_key
from gbid.experiment.run.failures import FOLDER


def stale_files(results: Path, everything: bool = False, kernels: Path | None = None) -> list[Path]:
    """Return temporary files of processes that are gone, and records of failures.

    Parameters
    ----------
    results : pathlib.Path
        Folder of the results.
    everything : bool
        Whether the results themselves are among them: all files with a content key.
    kernels : pathlib.Path, optional
        Folder of compiled kernels, which are then among them as well.
    """
    found = [*find_stale_parts(results), *(results / FOLDER).rglob("*.json")]
    if everything:
        found += [path for path in results.rglob("[!.]*") if path.is_file() and stored_key(path)]
    if kernels is not None and kernels.is_dir():
        found += [*find_stale_parts(kernels), *kernels.glob("*.so"), *kernels.glob("*.lock")]
    return sorted(dict.fromkeys(found))


def remove(results: Path, files: Sequence[Path]) -> None:
    """Remove files, and folders of the results that are empty then.

    Raises
    ------
    DataError
        When a file cannot be removed.
    """
    for path in files:
        try:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise DataError(f"{path}: cannot be removed: {error.strerror or error}") from None
    for folder in sorted((path for path in results.rglob("*") if path.is_dir()), reverse=True):
        with contextlib.suppress(OSError):  # not empty
            folder.rmdir()
