"""Folder of the model and experiment files that come with gbid."""

from __future__ import annotations

from pathlib import Path

from gbid.errors import UsageError


def share_folder(kind: str) -> Path:
    """Return the folder of the files that come with gbid.

    Parameters
    ----------
    kind : str
        ``"models"`` or ``"experiments"``.

    Returns
    -------
    pathlib.Path
        A folder inside the package when gbid was installed from a wheel, the top-level folder in a checkout.

    Raises
    ------
    UsageError
        When neither folder exists.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "_share" / kind, package.parent / kind):
        if folder.is_dir():
            return folder
    raise UsageError(f"the {kind} that come with gbid are missing beside {package}; reinstall gbid")
