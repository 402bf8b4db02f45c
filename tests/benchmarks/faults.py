"""Faults beneath gbid: failing writes and locks, a jumping clock, SIGTERM, runs side by side, fork and spawn.

``python -m tests.benchmarks.faults [--samples N] [--seed S] [--only KIND ...] [--verbs VERB ...]``

Kinds:

- writes: one call that changes a file (write, open, rename, fsync, ...) fails, or all from it on, with EIO, ENOSPC or
  EROFS; the calls are drawn from all that the verb makes.
- locks: each lock fails with ENOLCK, as on some network drives.
- clock: the system's clock jumps by ten years, back and ahead.
- terms: SIGTERM at a random instant.
- together: three commands at once on one folder.
- processes: fits in processes that were forked and spawned.

A command must end with code 0 and the results of an undisturbed run, or with another code, one line of error and no
traceback; the command after it, without the fault, must give these results. Nothing temporary may be left over.
"""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.kills import _LONGEST, Case, Tally, begin, complete, ended, left_over, make_cases
from tests.benchmarks.running import markdown, options_of, store

_VERBS = ("run", "tune", "report", "paper", "export", "batch")
_KINDS = ("writes", "locks", "clock", "terms", "together", "processes")
_PRELOADED = "GBID_FAULTS_PRELOADED"
_WRITES, _LOCKS, _CLOCK = 1, 2, 3
_ERRORS = (errno.EIO, errno.ENOSPC, errno.EROFS)


class Counter:
    """Count of disturbed calls in memory that a command shares with this process."""

    def __init__(self) -> None:
        self._value = ctypes.c_int.from_buffer(mmap.mmap(-1, mmap.PAGESIZE))

    def disturbing(self, what: int, first: int = 0, error: int = 0, always: bool = False) -> Callable[[], object]:
        """Return a function that begins to count, and to disturb from the first call on that fails."""
        self._value.value = 0
        return lambda: ctypes.CDLL(None).disturb(what, first, error, int(always), ctypes.byref(self._value))

    @property
    def calls(self) -> int:
        """Number of calls so far."""
        return self._value.value


def command(case: Case, folder: Path, before: Callable[[], object] = bool) -> tuple[int, Path]:
    """Begin the command of a case in a folder; return its process and its log."""
    log = folder / f"log{len(list(folder.glob('log*')))}.txt"
    return begin((case.verb, str(folder / "experiment.yaml"), *case.arguments), log, folder.name, before=before), log


def finish(process: int, log: Path, name: str, tally: Tally, allowed: tuple[int, ...] = ()) -> int:
    """Wait for a command and return its exit code; count a hang, a traceback, and an end without a line."""
    status = ended(process, _LONGEST)
    if status is None:
        os.kill(process, signal.SIGKILL)
        ended(process, 30.0)
        tally.fault("failed", f"{name}: hangs")
        return -1
    code, text = os.waitstatus_to_exitcode(status), log.read_text()
    lines = [line for line in text.splitlines() if line.startswith("gbid: ")]
    if "Traceback" in text or code not in (0, 2, 3, *allowed) or (code and not lines):
        tally.fault("failed", f"{name}: ends with {code}: {text[-600:]}")
    return code


def compare(case: Case, folder: Path, name: str, tally: Tally) -> None:
    """Count results that differ from those of an undisturbed run, and what is left over."""
    keys = {name: key for name, (key, _, _) in complete(folder / "results/killed").items()}
    for each in sorted({*keys, *case.expected}):
        if keys.get(each) != case.expected.get(each):
            tally.fault("lost", f"{name}: {each} differs")
    for each in left_over(folder):
        tally.fault("left", f"{name}: left over {each}")


def disturbed(case: Case, folder: Path, name: str, tally: Tally, before: Callable[[], object]) -> None:
    """Run a command with a fault, and after its failure once more without."""
    shutil.copytree(case.template, folder)
    tally.counts["commands"] += 1
    if finish(*command(case, folder, before), name, tally) != 0:
        tally.counts["refused"] += 1
        if finish(*command(case, folder), f"{name}, again", tally) != 0:
            tally.fault("failed", f"{name}: the next command fails, too")
    compare(case, folder, name, tally)
    shutil.rmtree(folder)


def writes(case: Case, folder: Path, chance: random.Random, samples: int, tally: Tally) -> None:
    """Let drawn writes of a verb fail, one in each command."""
    counter = Counter()
    disturbed(case, folder, f"{case.verb}, undisturbed", tally, counter.disturbing(_WRITES))
    total = counter.calls
    tally.counts["calls"] += total
    for first in sorted(chance.sample(range(1, total + 1), min(samples, total))):
        error, always = chance.choice(_ERRORS), chance.random() < 0.7
        name = f"{case.verb}, call {first} of {total}{' and all after it' * always}: {errno.errorcode[error]}"
        disturbed(case, folder, name, tally, counter.disturbing(_WRITES, first, error, always))


def terms(case: Case, folder: Path, chance: random.Random, samples: int, tally: Tally) -> None:
    """End a verb by SIGTERM at random instants."""
    for _ in range(samples):
        shutil.copytree(case.template, folder)
        instant = chance.uniform(0.0, case.seconds)
        process, log = command(case, folder)
        if ended(process, instant) is None:
            os.kill(process, signal.SIGTERM)
            finish(process, log, f"{case.verb}, SIGTERM after {instant:.2f} s", tally, (130,))
        tally.counts["commands"] += 1
        finish(*command(case, folder), f"{case.verb}, after SIGTERM at {instant:.2f} s", tally)
        compare(case, folder, f"{case.verb}, SIGTERM after {instant:.2f} s", tally)
        shutil.rmtree(folder)


def together(case: Case, folder: Path, tally: Tally) -> None:
    """Begin three equal commands at once."""
    shutil.copytree(case.template, folder)
    logs = [folder / f"log{i}.txt" for i in range(3)]
    arguments = (case.verb, str(folder / "experiment.yaml"), *case.arguments)
    processes = [begin(arguments, log, folder.name) for log in logs]
    codes = [finish(each, log, f"{case.verb}, one of three", tally) for each, log in zip(processes, logs, strict=True)]
    tally.counts.update(commands=3, refused=sum(code != 0 for code in codes))
    if 0 not in codes:
        tally.fault("failed", f"{case.verb}: all of three fail")
    compare(case, folder, f"{case.verb}, three at once", tally)
    shutil.rmtree(folder)


def fitted(_: int) -> list[float]:
    """Return the estimates of a small fit."""
    import numpy as np

    import gbid
    from gbid.structure import RotorBearing

    u = np.random.default_rng(1).choice([-5e-6, 5e-6], (2000, 2))
    p = gbid.load_model("theisen2016").at(6.0, 0.0).simulate(u, 2e-4)
    return list(gbid.fit(RotorBearing(), gbid.Recording({"u": u, "p": p}, 2e-4)).parameters.values())


def processes(tally: Tally) -> None:
    """Fit here, in forked and in spawned processes, and here again."""
    expected = fitted(0)
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(2) as pool:
            results = pool.map(fitted, range(4))
        tally.counts["commands"] += len(results)
        if any(result != expected for result in [*results, fitted(0)]):
            tally.fault("lost", f"{method}: other bits")


def study(samples: int, seed: int, kinds: Sequence[str], verbs: Sequence[str]) -> dict[str, Any]:
    """Return the counts by kind, and the faults in words."""
    chance, tallies = random.Random(seed), {kind: Tally() for kind in kinds}
    with tempfile.TemporaryDirectory(prefix="gbid-faults-") as name:
        folder = Path(name)
        os.environ["GBID_CACHE_DIR"] = str(folder / "kernels")
        (folder / "kernels").mkdir(mode=0o700)
        cases = make_cases(folder, verbs) if set(kinds) != {"processes"} else []
        for kind, tally in tallies.items():
            for case in cases if kind != "processes" else ():
                if kind == "writes":
                    writes(case, folder / "writes", chance, samples, tally)
                elif kind == "terms":
                    terms(case, folder / "terms", chance, samples, tally)
                elif kind == "together":
                    together(case, folder / "together", tally)
                else:
                    what, error = (_LOCKS, errno.ENOLCK) if kind == "locks" else (_CLOCK, 0)
                    before = Counter().disturbing(what, 1, error, always=True)
                    disturbed(case, folder / kind, f"{case.verb}, {kind}", tally, before)
                print(kind, case.verb, dict(tally.counts), tally.faults[-2:], flush=True)
            if kind == "processes":
                processes(tally)
    return {kind: {**tally.counts, "faults": tally.faults} for kind, tally in tallies.items()}


def table(run: dict[str, Any]) -> str:
    """Return the counts as Markdown."""
    shown = ("commands", "refused", "calls", "lost", "left", "failed")
    return markdown(["kind", *shown], [[kind, *(row.get(key, 0) for key in shown)] for kind, row in run.items()])


def main() -> None:
    """Run the study in a process with the library of faults, and print its table."""
    given = options_of(
        __doc__,
        samples=(10, "writes and SIGTERMs of each verb"),
        seed=(0, "of calls and instants"),
        only=(_KINDS, "kinds of faults"),
        verbs=(_VERBS, "verbs"),
    )
    if _PRELOADED not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "faults.so"
            source = Path(__file__).with_suffix(".c")
            subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
            again = [sys.executable, "-m", "tests.benchmarks.faults", *sys.argv[1:]]
            environment = {**os.environ, "LD_PRELOAD": str(library), _PRELOADED: "1"}
            raise SystemExit(subprocess.run(again, env=environment, check=False).returncode)
    computed = study(given.samples, given.seed, given.only, given.verbs)
    store(computed, given.output)
    print(json.dumps(computed, indent=1))
    print(table(computed))
    raise SystemExit(any(row["faults"] for row in computed.values()))


if __name__ == "__main__":
    main()
