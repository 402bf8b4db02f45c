"""What the studies share: the run's date, machine and version, and where its figures go."""

from __future__ import annotations

import datetime
import json
import platform
from pathlib import Path
from typing import Any

import gbid

DOCS = Path(__file__).resolve().parents[1] / "docs"


def about() -> dict[str, Any]:
    """Return date, processor and version of gbid, which stand under each table."""
    return {"date": datetime.date.today().isoformat(), "processor": processor(), "gbid": gbid.__version__}


def processor() -> str:
    """Return the model of the processor, without the name of the machine."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def stored(path: Path, empty: Any) -> Any:
    """Return the figures of an earlier run; `empty` without one."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else empty


def store(run: Any, path: Path | None) -> None:
    """Write the figures of a run to a JSON file, when one is named."""
    if path is not None:
        path.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")


def finish(run: Any, path: Path | None, text: str) -> int:
    """Store the figures of a run, print its table, and return the exit code."""
    store(run, path)
    print(text)
    return 0
