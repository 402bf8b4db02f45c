"""Folder of the compiled kernels, and whether its libraries can be trusted.

A library runs with the rights of the user. It is therefore taken only from folders in which nobody else can write,
which is the rule of ssh for its keys.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import stat
import tempfile
from functools import cache
from pathlib import Path

from platformdirs import user_cache_path

from gbid.atomic import remove_stale_parts, scratch_folder

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path:
    """Return the folder of the compiled kernels.

    It is the folder named by the environment variable ``GBID_CACHE_DIR``, otherwise the cache folder of the user.
    """
    named = os.environ.get("GBID_CACHE_DIR")
    return Path(named) if named else user_cache_path("gbid", appauthor=False) / "kernels"


@cache
def private_folder() -> Path:
    """Return a new folder of this process, which is removed at its end."""
    with contextlib.suppress(OSError):  # those of processes that were killed
        remove_stale_parts(Path(tempfile.gettempdir()), ".scratch.*")
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(scratch_folder(Path(tempfile.gettempdir()) / "kernels"))


def why_not_trusted(path: Path) -> str:
    """Return why the content of a file or folder could be another user's; empty when it could not.

    Parameters
    ----------
    path : pathlib.Path
        An existing file or folder. The folders above it are examined as well: who may write there may replace it.
    """
    if not hasattr(os, "getuid"):  # no owners of this kind
        return ""
    mine = (os.getuid(), 0)
    real = path.resolve()
    for place in (real, *real.parents):
        found = place.stat()
        if found.st_uid not in mine:
            return f"{place} belongs to another user"
        shared_safely = place != real and found.st_mode & stat.S_ISVTX  # as /tmp: entries are their owners'
        if found.st_mode & _OTHERS_MAY_WRITE and not shared_safely:
            return f"other users may write to {place}"
    return ""
