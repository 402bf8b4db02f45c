"""Kill gbid at random instants and run the same command again: what is lost, made twice, or left over.

``python -m tests.benchmarks.kills [--kills N] [--minutes M] [--seed S] [--only VERB ...] [--output FILE]``

The verbs are `run`, `batch` (with a pool of two workers, and as `dask` with a Dask cluster), `tune`, `report`, `paper`
(its figures), `export` (C source of a tuned controller) and `serve` (it never ends, so each of its campaigns is one
kill). A campaign is one verb on a fresh copy of what it needs: it is killed, checked and started again until it ends by
itself. The instant of a kill is drawn uniformly from the time that the verb takes undisturbed, so that it may fall into
anything. Most signals are SIGKILL; the others are SIGTERM, SIGINT and SIGHUP. With `batch` and `dask` every third
victim is a worker; the scheduler of Dask is part of the command.

Each command is a fork of this process, which has done the same work before: otherwise most kills would hit imports.

After each kill:

- orphans: processes of the command that are there after two seconds.

After each kill of `export` also:

- half: sets of C files of which some are missing or differ, and which the Makefile beside them would compile.

At the end of each campaign:

- lost: results that were complete at a kill and are gone, and results that differ from those of an undisturbed run.
- twice: results that were complete at a kill, with the content key that they have at the end, and were written again.
- left: temporary files and locks.

In a fifth of the campaigns of `run`, `report` and `paper` the first command may write no file larger than a few ten
kilobytes, as on a full disk: it must end with code 3, and the next one must go on.

In every other campaign the clock goes backwards: the times of the files are set years back or ahead after a kill, and
the command that follows is told a time that runs backwards.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.benchmarks.running import markdown, options_of, store

VERBS = {
    "run": 0.2,
    "batch": 0.06,
    "dask": 0.06,
    "tune": 0.2,
    "report": 0.14,
    "paper": 0.14,
    "export": 0.14,
    "serve": 0.06,
}
"""Share of the kills of each verb; `batch` has fewer, because its workers import everything anew."""
_SERIAL = ("--engine", "serial")
_ENGINES = {
    **{"run": _SERIAL, "tune": _SERIAL, "batch": ("--engine", "pool", "--workers", "2")},
    "dask": ("--engine", "dask", "--workers", "2"),
    **{"export": ("--to", "c"), "serve": ("--port", "0"), "paper": ("--only", "figures")},
}
_OF_WORKERS = ("batch", "dask")
_MARK = "GBID_KILL_STUDY"
_PATIENCE = 2.0  # time after which a process of a killed command is an orphan [s]
_LONGEST = 300.0  # time after which a command counts as hanging [s]
_SIGNALS = (signal.SIGKILL,) * 7 + (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_SERVED = 1.5  # time within which a server is killed [s]
_FULL = 0.2  # share of campaigns whose first command meets a limit on the size of files
_YEARS = 10 * 365.25 * 86400

_IMPORTED = """\
    - name: run{i}
      file: run{i}.csv
      time: time
      time_unit: ms
      conditions: {{pressure_bar: {bar}, speed_rpm: 0}}
      signals: {{u: {{columns: drive, stored_unit: V}}, y: {{columns: position, stored_unit: um}}}}
"""
_REST = """\
fits:
  spring: {{structure: "spring.py:structure", focus: simulation}}
crossval:
  spring: {{on: cyclic}}
{more}"""
_CONTROLLER = """\
controller:
  small:
    {structure: P, model: theisen2016, operating_points: [{pressure_bar: 6.0, speed_rpm: 0.0}], starts: 2,
     sample_time_s: 2.0e-4}
"""
_STRUCTURE = """\
import gbid


def matrices(p):
    return {"A": [[0, 1], [-p.k, -p.d]], "B": [[0], [p.b]], "C": [[1, 0]]}


parameters = [gbid.Parameter("k", 6e4), gbid.Parameter("d", 20.0), gbid.Parameter("b", 1e6)]
structure = gbid.LinearStructure("spring", parameters, matrices)
"""


_COUNTED = ("kills", "campaigns", "clocks", "full")
_FAULTS = ("lost", "twice", "half", "orphans", "left", "failed")


@dataclass
class Tally:
    """What happened to one verb: counts of kills and faults by name, signals, and the faults in words."""

    counts: Counter[str] = field(default_factory=Counter)
    longest_end_s: float = 0.0
    signals: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def fault(self, kind: str, text: str, count: int = 1) -> None:
        """Count a fault."""
        self.counts[kind] += count
        self.faults.append(text)


@dataclass(frozen=True)
class Case:
    """A verb with its folder to start from, its arguments, the undisturbed results and their time."""

    verb: str
    template: Path
    arguments: tuple[str, ...]
    expected: dict[str, str]
    seconds: float


def write_experiment(folder: Path, count: int, more: str) -> Path:
    """Write an experiment on files of a mass on a spring, one second or less each."""
    from gbid.cli.templates import write_example_data

    (folder / "data").mkdir(parents=True)
    for i in range(1, count + 1):
        write_example_data(folder / "data" / f"run{i}.csv", seed=i, n_samples=1000)
    entries = "".join(_IMPORTED.format(i=i, bar=5) for i in range(1, count + 1))
    (folder / "spring.py").write_text(_STRUCTURE)
    text = f"format: 1\nname: killed\nimport:\n  data_folder: data\n  recordings:\n{entries}"
    path = folder / "experiment.yaml"
    path.write_text(text + _REST.format(more=more))
    return path


def begin(
    arguments: Sequence[str],
    log: Path,
    mark: str,
    backwards: bool = False,
    largest: int = 0,
    before: Callable[[], object] = bool,
) -> int:
    """Return the process id of a command line, as a fork of this process in a session of its own.

    With `backwards` its clock runs backwards; with `largest` it may write no file of more bytes. The process calls
    `before` first.
    """
    blocked = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    signal.pthread_sigmask(signal.SIG_BLOCK, blocked)  # Python ignores what is raised within its functions at a fork
    process = os.fork()
    if process:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, blocked)
        return process
    code = 70
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout, sys.stderr = (os.fdopen(os.dup(number), "w") for number in (1, 2))
        os.environ[_MARK] = mark
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the study itself runs under nohup
        signal.pthread_sigmask(signal.SIG_UNBLOCK, blocked)
        if backwards:
            now, began = time.time() - _YEARS, time.monotonic()
            time.time = lambda: now - 100 * (time.monotonic() - began)  # type: ignore[assignment]
        if largest:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        from gbid.cli.main import app

        before()
        app(list(arguments), prog_name="gbid")
    except SystemExit as end:
        code = int(end.code or 0)
    except KeyboardInterrupt:  # before gbid's own guard is reached, where Python itself ends so
        code = 130
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def processes_of(mark: str) -> list[int]:
    """Return the processes that a marked command has started, itself left out."""
    results = []
    wanted = f"{_MARK}={mark}".encode()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if wanted in (entry / "environ").read_bytes().split(b"\0"):
                    results.append(int(entry.name))
    return results


def ended(process: int, seconds: float) -> int | None:
    """Wait for a process; return its status, None when it is still there."""
    deadline = time.monotonic() + seconds
    while True:
        ended_process, status = os.waitpid(process, os.WNOHANG)
        if ended_process:
            return status
        if time.monotonic() > deadline:
            return None
        time.sleep(0.002)


def complete(results: Path) -> dict[str, tuple[str, int, int]]:
    """Return content key, inode and time of each result that is there; what lies in a temporary folder is none."""
    from gbid.experiment.fields import stored_key

    results_by_name = {}
    for path in results.rglob("*"):
        name = path.relative_to(results)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            stat = path.stat()
            results_by_name[str(name)] = (stored_key(path), stat.st_ino, stat.st_mtime_ns)
    return results_by_name


def left_over(folder: Path) -> list[str]:
    """Return temporary files and folders, and locks."""
    return [path.name for path in folder.rglob(".*")]


def make_cases(folder: Path, verbs: Sequence[str] = tuple(VERBS)) -> list[Case]:
    """Return the cases after an undisturbed run of each; the later verbs start from made results."""
    small, many = folder / "small", folder / "many"
    write_experiment(small, 2, _CONTROLLER)
    write_experiment(many, 10, "")
    cases = []
    before = {
        "tune": ("import", "fit", "crossval"),
        **dict.fromkeys(("report", "paper", "export", "serve"), ("run",)),
    }
    for verb in verbs:
        template = folder / verb
        shutil.copytree(many if verb in _OF_WORKERS else small, template)
        for earlier in before.get(verb, ()):
            _here((earlier, str(template / "experiment.yaml"), "--engine", "serial"))
        if verb == "report":
            (template / "results/killed/report.html").unlink()
        arguments = _ENGINES.get(verb, ())
        if verb == "serve":
            expected = {name: key for name, (key, _, _) in complete(template / "results/killed").items()}
            cases.append(Case(verb, template, arguments, expected, _SERVED))
            continue
        done = folder / f"{verb}_done"
        shutil.copytree(template, done)
        if verb not in _OF_WORKERS:
            warm = folder / f"{verb}_warm"
            shutil.copytree(template, warm)
            _here((verb, str(warm / "experiment.yaml"), *arguments))
        log, began = folder / "log.txt", time.monotonic()
        status = ended(begin((_verb(verb), str(done / "experiment.yaml"), *arguments), log, "undisturbed"), _LONGEST)
        seconds = time.monotonic() - began
        if status != 0:
            raise SystemExit(f"gbid {verb}: status {status}\n{log.read_text()}")
        expected = {name: key for name, (key, _, _) in complete(done / "results/killed").items()}
        cases.append(Case(verb, template, arguments, expected, seconds))
        print(f"{verb}: {len(expected)} results, {seconds:.2f} s", flush=True)
    return cases


def _here(arguments: tuple[str, ...]) -> None:
    """Run a command in this process, so that its forks have all that it loads."""
    from gbid.cli.main import app

    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as told:
            app(list(arguments), prog_name="gbid")
    except SystemExit as end:
        if end.code:
            raise SystemExit(f"gbid {' '.join(arguments)}: {told.getvalue()}") from None


def campaign(case: Case, folder: Path, chance: random.Random, tally: Tally, most: int) -> None:
    """Run one campaign: kill and start again until the command ends by itself, or `most` kills are done."""
    shutil.copytree(case.template, folder)
    results, log = folder / "results/killed", folder / "log.txt"
    arguments = (_verb(case.verb), str(folder / "experiment.yaml"), *case.arguments)
    clock = tally.counts["campaigns"] % 2 == 1
    tally.counts.update(campaigns=1, clocks=clock)
    seen: dict[str, tuple[str, int, int]] = {}
    for attempt in range(1000):
        mark = f"{os.getpid()}-{folder.name}-{attempt}"
        full = attempt == 0 and chance.random() < _FULL and case.verb in ("run", "report", "paper")
        largest = chance.randrange(2_000, 60_000) if full else 0
        process = begin(arguments, log, mark, clock and attempt > 0, largest)
        by_worker = case.verb in _OF_WORKERS and attempt % 3 == 2
        allowed = (tally.counts["kills"] < most and not full) or case.verb == "serve"
        status = ended(process, chance.uniform(0.0, case.seconds) if allowed else _LONGEST)
        number = chance.choice(_SIGNALS)
        if status is None and allowed:
            workers = [p for p in processes_of(mark) if p != process and _is_worker(p)] if by_worker else []
            victim = chance.choice(workers) if workers else process
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL if workers else number)
                tally.counts["kills"] += 1
                tally.signals["SIGKILL of a worker" if workers else number.name] += 1
            status = ended(process, _LONGEST if workers else 30.0)
        if status is None:
            os.kill(process, signal.SIGKILL)
            status = ended(process, 30.0)
            tally.fault("failed", f"{folder.name}: hangs after {number.name}: {log.read_text()[-300:]}")
        _check_orphans(mark, tally, folder)
        if case.verb == "export" and (half := compiled_half_set(results / "export", case.expected)):
            tally.fault("half", f"{folder.name}: {half}")
        now = complete(results)
        for name, entry in seen.items():
            if name not in now:
                tally.fault("lost", f"{folder.name}: {name} is gone")
            elif now[name][0] == entry[0] and now[name][1:] != entry[1:]:
                tally.fault("twice", f"{folder.name}: {name} was made twice")
        if status == 0 or case.verb == "serve":
            break
        code = os.waitstatus_to_exitcode(status or 0)
        if full and code == 3 and "may write (ulimit -f)" in log.read_text():
            tally.counts["full"] += 1
            seen = now
            continue
        if code not in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT, 130):
            tally.fault("failed", f"{folder.name}: ends with {code}: {log.read_text()[-300:]}")
            if code == 2:
                return
        if clock:
            for name in now:
                with contextlib.suppress(FileNotFoundError):
                    when = time.time() + chance.choice((-1, 1)) * _YEARS
                    os.utime(results / name, (when, when))
            now = complete(results)
        seen = now
    keys = {name: key for name, (key, _, _) in complete(results).items()}
    for name in sorted({*keys, *case.expected}):
        if keys.get(name) != case.expected.get(name):
            tally.fault("lost", f"{folder.name}: {name} differs from the undisturbed run")
    for name in left_over(folder):
        tally.fault("left", f"{folder.name}: left over {name}")
    shutil.rmtree(folder)


def compiled_half_set(folder: Path, expected: Mapping[str, str]) -> str:
    """Return what is wrong with a folder of C source that is not whole and compiles all the same; else nothing."""
    missing = [name for name in expected if name.startswith("export/") and not (folder.parent / name).is_file()]
    makefiles = list(folder.glob("*.mk")) if missing else []
    for makefile in makefiles:
        command = ["make", "-B", "-C", str(folder), "-f", makefile.name]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return f"{makefile.name} compiles without {', '.join(missing)}"
    return ""


def _verb(case: str) -> str:
    return "batch" if case == "dask" else case


def _is_worker(process: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def _check_orphans(mark: str, tally: Tally, folder: Path) -> None:
    began = time.monotonic()
    while orphans := processes_of(mark):
        waited = time.monotonic() - began
        if waited > _PATIENCE:
            tally.fault("orphans", f"{folder.name}: {len(orphans)} processes outlive their runner", len(orphans))
            for process in orphans:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            return
        tally.longest_end_s = max(tally.longest_end_s, waited)
        time.sleep(0.01)


def study(kills: int, minutes: float, seed: int, output: Path | None, shares: Mapping[str, float]) -> dict[str, Any]:
    """Return the figures of a study: for each verb the counts, and the faults in words; also written on the way."""
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="gbid-kills-") as name:
        folder = Path(name)
        kernels = folder / "kernels"
        kernels.mkdir(mode=0o700)
        os.environ["GBID_CACHE_DIR"] = str(kernels)
        cases = make_cases(folder, tuple(shares))
        tallies = {case.verb: Tally() for case in cases}
        deadline = time.monotonic() + 60 * minutes
        number, most = 0, {verb: round(share * kills) for verb, share in shares.items()}
        while time.monotonic() < deadline and any(tallies[verb].counts["kills"] < most[verb] for verb in shares):
            left = [case for case in cases if tallies[case.verb].counts["kills"] < most[case.verb]]
            for case in sorted(left, key=lambda case: tallies[case.verb].counts["kills"] / shares[case.verb])[:2]:
                number += 1
                campaign(case, folder / f"{case.verb}{number}", chance, tallies[case.verb], most[case.verb])
            figures = _figures(seed, kills, tallies, ())
            faults = [fault for tally in tallies.values() for fault in tally.faults]
            print(f"{figures['kills']} kills, {len(faults)} faults {faults[-2:]}", flush=True)
            store(figures, output)
        return _figures(seed, kills, tallies, left_over(kernels))


def _figures(seed: int, kills: int, tallies: Mapping[str, Tally], stale: Sequence[str]) -> dict[str, Any]:
    verbs = {
        verb: {word: tally.counts[word] for word in _COUNTED + _FAULTS} | {"faults": tally.faults}
        for verb, tally in tallies.items()
    }
    return {
        "seed": seed,
        "asked": kills,
        **{word: sum(row[word] for row in verbs.values()) for word in _COUNTED + _FAULTS},
        "longest_end_s": round(max(tally.longest_end_s for tally in tallies.values()), 2),
        "left_in_cache": list(stale),
        "signals": dict(sum((tally.signals for tally in tallies.values()), Counter())),
        "verbs": verbs,
    }


def table(run: Mapping[str, Any]) -> str:
    """Return the counts of each verb as Markdown."""
    shown = {"kills": "kills", "campaigns": "rounds", "clocks": "rounds with another clock", "full": "full disks"}
    shown |= {"lost": "lost", "twice": "made twice", "half": "half sets", "orphans": "processes after 2 s"}
    shown |= {"left": "left over", "failed": "hangs, wrong codes"}
    rows = [[f"`gbid {verb}`", *(row[key] for key in shown)] for verb, row in run["verbs"].items()]
    return markdown(["verb", *shown.values()], [*rows, ["all", *(run[key] for key in shown)]])


def main() -> None:
    """Run the study and write its figures."""
    given = options_of(
        __doc__,
        kills=(1000, "how many"),
        minutes=(240.0, "at most"),
        seed=(0, "of instants and signals"),
        only=(tuple(VERBS), "verbs"),
    )
    whole = sum(VERBS[verb] for verb in given.only)
    shares = {verb: VERBS[verb] / whole for verb in given.only}
    computed = study(given.kills, given.minutes, given.seed, given.output, shares)
    store(computed, given.output)
    print(json.dumps(computed, indent=1))
    raise SystemExit(any(computed[word] for word in _FAULTS))


if __name__ == "__main__":
    main()
