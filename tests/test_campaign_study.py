"""Ten campaigns, each disturbed by kill -9 at a random instant and resumed until it is done."""

import os
import random
import signal
import time

import pytest
from campaign_files import batch, left_over, rows_of, stamps, workers_of, write_springs
from experiment_files import gbid

INSTANTS = 10


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["runner", "worker"])
def test_kill_at_random_instants(victim, tmp_path, record_property):
    """The final table is that of an undisturbed run, and no fit that was complete is made again."""
    undisturbed = write_springs(tmp_path / "undisturbed", 24, n=3000)
    began = time.monotonic()
    process = batch(undisturbed, "--engine", "pool", "--workers", "2")
    process.communicate()
    assert process.returncode == 0
    whole = time.monotonic() - began
    expected = rows_of(undisturbed.parent / "results" / "springs" / "table.csv")
    seed = time.time_ns() % 2**32
    record_property("seed", seed)
    chance = random.Random(seed)
    kills = 0
    for i in range(INSTANTS):
        path = write_springs(tmp_path / f"run{i}", 24, n=3000)
        results = path.parent / "results" / "springs"
        complete = {}
        while True:
            process = batch(path, "--engine", "pool", "--workers", "2")
            deadline = time.monotonic() + chance.uniform(0.0, whole)
            while process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.002)
            if process.poll() is None and kills <= i:
                targets = [process.pid] if victim == "runner" else workers_of(process)[:1]
                for pid in targets:
                    os.kill(pid, signal.SIGKILL)
                    kills += 1
            _, err = process.communicate()
            now = stamps(results)
            assert {name: now[name] for name in complete} == complete, f"seed {seed}: a complete fit was made again"
            complete = now
            if process.returncode == 0:
                break
            assert process.returncode == -signal.SIGKILL, f"seed {seed}: {err}"
        if not (results / "table.csv").exists():
            assert gbid("batch", path, "--collect") == 0
        assert rows_of(results / "table.csv") == expected, f"seed {seed}"
        assert left_over(results) == []
    assert kills >= INSTANTS // 2, f"seed {seed}: only {kills} kills hit something"
