"""The model and experiment files that come with gbid."""

from __future__ import annotations

from pathlib import Path

from gbid.errors import UsageError


def share_folder(kind: str) -> Path:
    """Folder of the files that come with gbid.

    Parameters
    ----------
    kind : str
        ``"models"`` or ``"experiments"``.

    Returns
    -------
    pathlib.Path
        Inside the package when installed from a wheel, at the top level in a checkout.

    Raises
    ------
    UsageError
        When neither is there.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "_share" / kind, package.parent / kind):
        if folder.is_dir():
            return folder
    raise UsageError(f"the {kind} that come with gbid are missing beside {package}; reinstall gbid")
