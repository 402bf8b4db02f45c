"""Campaigns disturbed by kill -9 at random instants and run again: runner or worker, on the pool and on Dask."""

import os
import random
import signal
import time
from pathlib import Path

import pytest
from campaign_files import NEEDS_DASK, alive, batch, left_over, rows_of, stamps, workers_of, write_springs

INSTANTS, COUNT = 10, 24
ITEMS = 2 * COUNT  # an import and a fit for each
ENGINES = ["pool", pytest.param("dask", marks=NEEDS_DASK)]


def results_of(path):
    return path.parent / "results" / "springs"


def how_far(results):
    """Files that are complete."""
    return len(list(results.glob("recordings/[!.]*.h5"))) + len(stamps(results))


def wait_until(true, process):
    """Wait as long as the process runs; tell whether it happened."""
    while process.poll() is None:
        if true():
            return True
        time.sleep(0.001)
    return False


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Table of a run that nothing disturbed."""
    path = write_springs(tmp_path_factory.mktemp("undisturbed"), COUNT, n=3000)
    process = batch(path, "--engine", "serial")
    _, err = process.communicate()
    assert process.returncode == 0, err
    return rows_of(results_of(path) / "table.csv")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc to find the workers")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("victim", ["runner", "worker"])
def test_kill_at_random_instants(victim, engine, expected, tmp_path, record_property):
    """Ten campaigns, one kill in each; then the same command again.

    An instant is a random count of complete files and up to 30 ms more, so that it falls into the work however fast
    the machine is. The table is that of an undisturbed run, and no fit that was complete is made again.
    """
    seed = time.time_ns() % 2**32
    record_property("seed", seed)
    chance = random.Random(seed)
    kills = 0
    for i in range(2 * INSTANTS):
        if kills == INSTANTS:
            break
        path = write_springs(tmp_path / f"run{i}", COUNT, n=3000)
        results, command = results_of(path), (path, "--engine", engine, "--workers", "2")
        count = chance.randrange(ITEMS - 2)
        process = batch(*command)
        if not wait_until(lambda r=results, n=count, p=process: how_far(r) >= n and len(workers_of(p)) == 2, process):
            process.communicate()
            continue  # it was done before we looked
        time.sleep(chance.uniform(0.0, 0.03))
        workers, there = workers_of(process), stamps(results)
        target = process.pid if victim == "runner" else chance.choice(workers)
        os.kill(target, signal.SIGKILL)
        kills += 1
        _, err = process.communicate()
        where = f"seed {seed}, campaign {i}, {len(there)} fits were there: {err}"
        assert process.returncode == (-signal.SIGKILL if victim == "runner" else 0), where
        deadline = time.monotonic() + 30
        while any(alive(pid) for pid in workers):
            assert time.monotonic() < deadline, f"{where}: a worker outlives its runner"
            time.sleep(0.02)
        there = {**stamps(results), **there}
        again = batch(*command)
        _, err = again.communicate()
        assert again.returncode == 0, f"{where}; then {err}"
        now = stamps(results)
        assert {name: now[name] for name in there} == there, f"{where}: a complete fit was made again"
        assert rows_of(results / "table.csv") == expected, where
        assert left_over(results) == [], where
    assert kills == INSTANTS, f"seed {seed}: only {kills} kills hit a run"
