"""Shell completion: YAML files and folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def files_ending(*endings: str) -> Callable[[str], list[str]]:
    """Return a function that completes the beginning of a path by folders and files with one of the endings."""

    def complete(incomplete: str) -> list[str]:
        written, slash, begun = incomplete.rpartition("/")
        folder = Path(written + slash).expanduser() if slash else Path()
        try:
            found = sorted(folder.iterdir())
        except OSError:
            return []
        offered = []
        for path in found:
            if path.name.startswith(begun) and (begun.startswith(".") or not path.name.startswith(".")):
                if path.is_dir():
                    offered.append(f"{written}{slash}{path.name}/")
                elif path.suffix in endings:
                    offered.append(f"{written}{slash}{path.name}")
        return offered

    return complete


complete_experiment = files_ending(".yaml", ".yml")
complete_source = files_ending(".yaml", ".yml", ".h5")
