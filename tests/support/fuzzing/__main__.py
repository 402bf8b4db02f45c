"""`make fuzz`: many mutated files, read in processes that are watched; prints and writes the figures.

Each input follows from the seed and its number, so that it can be made again: ``--replay SEED/NUMBER``. Files of gbid
contain the time of their writing; only in this does an input differ when it is made again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import resource
import signal
import sys
import tempfile
import time
from collections import Counter, deque
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from random import Random
from typing import Any

import gbid
from fuzzing.outcome import FAULTS, HANG, InputOutcome, TriedInput, choose, try_input
from fuzzing.targets import FuzzTarget, fuzz_targets
from fuzzing.zip_mutations import npz_bomb

_FORK = multiprocessing.get_context("fork")
_STUCK = 600.0  # time [s] on a loaded machine after which the process of an input is ended
_ADDRESSES = 4 << 30  # most memory of a process of ours, beyond which python raises MemoryError
_AT_ONCE = 500  # inputs that a process reads
_KEPT = 200  # most faults that are written


def made_input(targets: list[FuzzTarget], seed: int, number: int) -> tuple[FuzzTarget, bytes]:
    """Return the input of a number."""
    random = Random(f"{seed}/{number}")
    target = choose(targets, random)
    return target, target.mutate(random, target.content)


def main() -> int:
    """Run the inputs; return 1 when one of them found a fault."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=None, help="number of inputs; without it, as many as fit the time")
    parser.add_argument("--minutes", type=float, default=None)
    parser.add_argument("--seed", type=int, default=None, help="by default another one in each run")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the name of the targets")
    parser.add_argument("--output", type=Path, default=None, help="JSON file for the figures")
    parser.add_argument("--replay", default="", help="SEED/NUMBER of one input to read again")
    parser.add_argument("--again", type=Path, default=None, help="figures whose faults are read again, once mended")
    given = parser.parse_args()
    targets = [target for target in fuzz_targets() if given.only in target.name]
    if given.replay:
        seed, number = map(int, given.replay.split("/"))
        target, content = made_input(targets, seed, number)
        with tempfile.TemporaryDirectory() as folder:
            print(target.name, *try_input(target, content, Path(folder)), sep="\n")  # noqa: T201
            if given.output:
                given.output.write_bytes(content)
        return 0
    if given.again:
        return _read_again(targets, given.again)
    npz_bomb()  # once, for all workers
    seed = int(time.time()) if given.seed is None else given.seed
    until = time.monotonic() + 60 * (given.minutes if given.minutes is not None else 1e9 if given.count else 60)
    run = FuzzRun(targets, seed, given.count or sys.maxsize, until)
    run.go(given.jobs)
    document = run.document()
    print(json.dumps({**document, "faults": document["faults"][:20]}, indent=1))  # noqa: T201
    if given.output:
        given.output.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return int(bool(document["faults"]))


def _read_again(targets: list[FuzzTarget], figures: Path) -> int:
    """Read the faults of a run again, count them as what they are now, and keep what they were."""
    document = json.loads(figures.read_text(encoding="utf-8"))
    remaining, mended = [], document.setdefault("mended", [])
    for fault in document["faults"]:
        target, content = made_input(targets, *map(int, fault["input"].split("/")))
        with tempfile.TemporaryDirectory() as folder:
            tried = try_input(target, content, Path(folder))
        for counts in (document["outcomes"], document["targets"][target.name]):
            counts[fault["outcome"]] -= 1
            counts[tried.outcome.value] = counts.get(tried.outcome.value, 0) + 1
        if tried.outcome in FAULTS:
            remaining.append({**fault, "outcome": tried.outcome.value, "text": tried.text[-1500:]})
        else:
            mended.append(
                {"input": fault["input"], "target": target.name, "was": fault["outcome"], "is": tried.outcome.value}
            )
    document["faults"] = remaining
    figures.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return int(bool(remaining))


class FuzzRun:
    """Inputs from number 0 on, handed to processes; one that hangs or dies is replaced."""

    def __init__(self, targets: list[FuzzTarget], seed: int, count: int, until: float) -> None:
        self._targets, self._seed, self._count, self._until = targets, seed, count, until
        self._next = 0
        self._running: dict[Any, tuple[BaseProcess, deque[int]]] = {}
        self._counts: dict[str, Counter[str]] = {target.name: Counter() for target in targets}
        self._faults: list[dict[str, Any]] = []
        self._slowest = self._largest = 0.0
        self._began = time.monotonic()

    def go(self, jobs: int) -> None:
        """Run until the count or the time is reached."""
        for _ in range(jobs):
            self._start(deque())
        said = time.monotonic()
        while self._running:
            for pipe in wait(list(self._running)):
                self._receive(pipe)
            if time.monotonic() - said > 30:
                said = time.monotonic()
                total: Counter[str] = sum(self._counts.values(), Counter())
                rate = total.total() / (said - self._began)
                sys.stderr.write(f"{total.total()} inputs, {rate:.0f}/s, {dict(total)}\n")

    def document(self) -> dict[str, Any]:
        """Return the figures."""
        total: Counter[str] = sum(self._counts.values(), Counter())
        rows = {
            target.name: {"origin": target.origin.value, "bytes": len(target.content), **self._counts[target.name]}
            for target in self._targets
        }
        return {
            "gbid": gbid.__version__,
            "python": platform.python_version(),
            "seed": self._seed,
            "inputs": total.total(),
            "seconds": round(time.monotonic() - self._began),
            "slowest_s": round(self._slowest, 2),
            "largest_growth_mb": round(self._largest / 1e6),
            "outcomes": {outcome.value: total[outcome.value] for outcome in InputOutcome},
            "targets": rows,
            "faults": self._faults[:_KEPT],
        }

    def _start(self, numbers: deque[int]) -> None:
        """Start a process with the numbers that another one left, or with new ones while there are any."""
        if not numbers and time.monotonic() < self._until:
            numbers.extend(range(self._next, min(self._next + _AT_ONCE, self._count)))
            self._next += len(numbers)
        if numbers:
            pipe, theirs = _FORK.Pipe(duplex=False)
            process = _FORK.Process(target=_work, args=(theirs, self._targets, self._seed, list(numbers)))
            process.start()
            theirs.close()
            self._running[pipe] = process, numbers

    def _receive(self, pipe: Any) -> None:
        process, numbers = self._running[pipe]
        try:
            tried = pipe.recv()
        except (EOFError, OSError):
            del self._running[pipe]
            process.join()
            if numbers:
                outcome = InputOutcome.HANG if process.exitcode == -signal.SIGALRM else InputOutcome.TRACEBACK
                words = f"the process ended with code {process.exitcode}"
                self._note(numbers.popleft(), TriedInput(outcome, HANG, 0, words))
            self._start(numbers)
        else:
            self._note(numbers.popleft(), tried)

    def _note(self, number: int, tried: TriedInput) -> None:
        name = choose(self._targets, Random(f"{self._seed}/{number}")).name
        self._counts[name][tried.outcome.value] += 1
        if tried.outcome not in FAULTS:
            self._slowest, self._largest = max(self._slowest, tried.seconds), max(self._largest, tried.growth)
        else:
            again = f"{self._seed}/{number}"
            fault = {"input": again, "target": name, "outcome": tried.outcome.value, "text": tried.text[-1500:]}
            self._faults.append(fault)
            sys.stderr.write(f"{again} {name}: {tried.outcome.value}: {tried.text.strip().splitlines()[-1:]}\n")


def _work(pipe: Connection, targets: list[FuzzTarget], seed: int, numbers: list[int]) -> None:
    """Read the inputs of some numbers; the alarm ends the process when one of them takes too long."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + _ADDRESSES, resource.RLIM_INFINITY))
    os.chdir("/")
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            signal.setitimer(signal.ITIMER_REAL, _STUCK)
            target, content = made_input(targets, seed, number)
            pipe.send(try_input(target, content, Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
