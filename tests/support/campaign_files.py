"""Small campaigns for the tests, and tasks that do strange things in a worker."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

from experiment_files import SPRING_STRUCTURE, write_spring_data
from places import ROOT

from gbid.cli.progress import Tally
from gbid.core.errors import DataError, NoSpaceError
from gbid.experiment.fields import Item
from gbid.experiment.run import Made, Reporter, Task

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}

ENTRY = """\
    - name: run{i}
      file: run{i}.csv
      time: time
      conditions: {{pressure_bar: {pressure}, speed_rpm: 0}}
      signals: {{u: {{columns: drive, stored_unit: V, channels: u}}, y: {{columns: position, stored_unit: um}}}}
"""


def write_springs(folder: Path, count: int, n: int = 400, fit: str = "focus: simulation", damage=None) -> Path:
    """A campaign on `count` csv files of a mass on a spring; `damage` spoils some of them, by number."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = "".join(ENTRY.format(i=i, pressure=3 + i % 5) for i in range(1, count + 1))
    path = folder / "experiment.yaml"
    path.write_text(
        f"format: 1\nname: springs\nimport:\n  data_folder: data\n  recordings:\n{entries}"
        f'fits:\n  spring: {{structure: "spring.py:structure", {fit}}}\n'
    )
    (folder / "spring.py").write_text(SPRING_STRUCTURE)
    (folder / "data").mkdir(exist_ok=True)
    for i in range(1, count + 1):
        write_spring_data(folder / "data" / f"run{i}.csv", i, n=n, damage=(damage or {}).get(i))
    return path


def command(*arguments, **options) -> subprocess.Popen:
    """`gbid` as its own process."""
    return subprocess.Popen(
        [sys.executable, "-m", "gbid.cli.main", *map(str, arguments)],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


batch = partial(command, "batch")


def workers_of(process: subprocess.Popen) -> list[int]:
    """Worker processes of a runner; those that keep track of resources are none."""
    try:
        threads = Path(f"/proc/{process.pid}/task").glob("*/children")  # of any thread: Dask starts them in one
        children = [child for listed in threads for child in listed.read_text().split()]
        return [int(c) for c in children if b"resource_tracker" not in Path(f"/proc/{c}/cmdline").read_bytes()]
    except OSError:
        return []


def interrupts_blocked(pid: int) -> bool:
    """Whether Ctrl-C does not reach a process, not even while it starts."""
    mask = re.search(r"SigBlk:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    return mask is not None and bool(int(mask[1], 16) & 1 << (signal.SIGINT - 1))


def poison(folder: Path) -> Path:
    """Write a Python file for each module; what is executed of them adds its name to the file that is returned."""
    note = folder / "executed"
    note.write_text("")
    optional = {"nptdms", "asammdf", "pyarrow", "pyuff", "matio", "pandas", "distributed", "ziglang", "lazy_loader"}
    loaded = {name.partition(".")[0] for name in sys.modules} - {"gbid", "__main__", "__mp_main__"}
    for name in {*optional, *loaded, *sys.stdlib_module_names}:
        (folder / f"{name}.py").write_text(f"open({str(note)!r}, 'a').write('{name} ')\n")
    return note


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for seconds until its parent hears it."""
    try:
        os.kill(pid, 0)
        status = Path(f"/proc/{pid}/status").read_text() if Path("/proc/self").is_dir() else ""
    except (ProcessLookupError, FileNotFoundError):
        return False
    return "\nState:\tZ" not in status


def stamps(results: Path) -> dict[str, int]:
    """When each fit that is there was written."""
    return {p.stem: p.stat().st_mtime_ns for p in results.glob("fits/*/[!.]*.h5")}


def rows_of(csv_file: Path) -> list[dict[str, str]]:
    """Rows of a table, times left out."""
    with csv_file.open() as handle:
        rows = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    return [{k: v for k, v in row.items() if k != "wall_time_s"} for row in rows]


def left_over(results: Path) -> list[Path]:
    """Temporary files and locks."""
    return [p for p in results.rglob(".*") if p.is_file()]


# Tasks that a worker can find by name.


def write_number(job, part, item):
    part.write_text(f"content_key: {item * 64}\n")
    return Made(str(os.getpid()))


def die(job, part, item):
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(job, part, item):
    mark = job.experiment.results / f"{item}.died"
    if not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return write_number(job, part, item)


def write_slowly(job, part, item):
    time.sleep(0.05)
    return write_number(job, part, item)


def meet(job, part, item):
    """End when another one runs, too, in another worker."""
    here = part.parent / f"{item}.here"
    here.write_text("")
    while len(list(part.parent.glob("*.here"))) < 2:
        time.sleep(0.01)
    return write_number(job, part, item)


class Watcher(Reporter):
    """A reporter that notes after each outcome how many of the tasks are done, and how many run."""

    def __init__(self):
        self.tally, self.seen = Tally(), []

    def expect(self, stage, todo, there, failed):
        self.tally = Tally(stage, todo, there, failed)

    def begin(self, item):
        self.tally.begin(item)

    def end(self, outcome):
        self.tally.end(outcome)
        self.seen.append((self.tally.done, self.tally.running))


def refuse(job, part, item):
    raise DataError(f"{item} is bad")


def defect(job, part, item):
    raise ZeroDivisionError("oh")


def full_disk(job, part, item):
    raise NoSpaceError(f"No space left for {item}")


def sleep(job, part, item):
    time.sleep(60)


def task(folder: Path, item: str, write) -> Task:
    """A task of these; the name is a hexadecimal digit, so that its key is one."""
    return Task(Item("toy", item), folder / f"{item}.txt", item * 64, partial(write, item=item))
