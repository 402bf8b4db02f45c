import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import campaign_files as files
import numpy as np
import pytest
from campaign_files import alive, batch, interrupts_blocked, left_over, rows_of, stamps, task, workers_of, write_springs
from experiment_files import gbid, json_of, printed_by, write_spring_data
from places import SUPPORT

from gbid import load
from gbid.core.errors import NoSpaceError, UsageError
from gbid.core.files import remove_stale_parts
from gbid.experiment.campaign import (
    NOT_MADE,
    Shard,
    collect,
    early_tasks,
    locked,
    read_shard,
    run_campaign,
    tasks_for,
    tasks_of,
    working,
)
from gbid.experiment.engines import ATTEMPTS, FEW, ONE_THREAD, ProcessPool, make_engine
from gbid.experiment.experiment import Experiment, digest_or_not
from gbid.experiment.load import load_experiment
from gbid.experiment.run import InTurn, Job, remembered_failure, run_tasks
from gbid.experiment.stages import importing
from gbid.experiment.stages.fit import fit_tasks
from gbid.experiment.stages.rig import rig_tasks

PROC = pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc to find the workers")


@pytest.fixture(scope="module")
def springs(tmp_path_factory):
    """A campaign of ten fits that nothing disturbed."""
    path = write_springs(tmp_path_factory.mktemp("springs"), 10)
    assert gbid("batch", path, "--engine", "serial") == 0
    return path


@pytest.fixture
def fresh(tmp_path):
    return write_springs(tmp_path / "fresh", 10)


@pytest.fixture(scope="module")
def pool():
    """Two workers, which stay."""
    made = ProcessPool(2)
    yield made
    made.close()


@pytest.fixture
def job(tmp_path):
    return Job(load_experiment(write_springs(tmp_path, 2), tmp_path / "results"))


def results_of(path):
    return path.parent / "results" / "springs"


def table_of(path):
    return rows_of(results_of(path) / "table.csv")


def test_table_is_that_of_the_fits(springs):
    table = load(results_of(springs) / "table.h5")
    rows = table_of(springs)
    assert len(table) == len(rows) == 10
    assert table.success.all()
    for i, row in enumerate(rows):
        result = load(results_of(springs) / "fits" / "spring" / f"{row['model']}.h5")
        assert table.row("spring", row["model"])["k"] == result.parameters["k"] == float(row["k"])
        assert float(row["k_std"]) == result.std["k"]
        np.testing.assert_array_equal(table.covariance[i], result.covariance)
        assert (table.mode_frequency_hz[i, 0], table.mode_damping[i, 0]) == result.model.modes()[0]
        assert table.static_gain[i, 0] == result.model.static_gain()[0, 0]
        assert float(row["fit_percent_y"]) == result.fit_percent[0, 0]
        assert table.pressure_bar[i] == 3 + (i + 1) % 5


def test_a_second_run_changes_nothing(springs, capsys):
    before = {p: p.read_bytes() for p in results_of(springs).rglob("*") if p.is_file()}
    document = json_of(capsys, "batch", springs)
    assert document["stages"]["fit"] == {"made": 0, "kept": 10, "failed": 0, "not_converged": 0}
    assert document["fits"][0]["converged"] == 10
    assert {p: p.read_bytes() for p in results_of(springs).rglob("*") if p.is_file()} == before
    assert left_over(results_of(springs)) == []


def test_pool_gives_what_this_process_gives(pool, springs, fresh):
    outcomes = run_campaign(Job(load_experiment(fresh), engine=pool))
    assert [o.state for o in outcomes] == ["made"] * 20
    assert [str(o.item) for o in outcomes if o.item.stage == "fit"] == [f"spring/run{i}" for i in range(1, 11)]
    assert gbid("batch", fresh, "--collect") == 0
    assert table_of(fresh) == table_of(springs)


def test_work_on_the_keys_of_a_campaign_is_proportional_to_its_size(tmp_path, monkeypatch):
    experiment = load_experiment(write_springs(tmp_path, 12))
    content, matching = Counter(), []
    key, fit_recordings = importing.content_key, Experiment.fit_recordings
    monkeypatch.setattr(importing, "content_key", lambda stage, *taken: content.update([stage]) or key(stage, *taken))
    monkeypatch.setattr(Experiment, "fit_recordings", lambda e, fit: matching.append(fit) or fit_recordings(e, fit))
    for planned in experiment.recordings.values():
        importing.refuse_same_content(experiment, planned)
    assert len(fit_tasks(Job(experiment))) == content["content"] == 12
    assert matching == ["spring"]


def wait_for_end(workers, within_s):
    deadline = time.monotonic() + within_s
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.02)


@PROC
def test_kill_of_workers_and_of_the_pool_runner(springs, fresh):
    """One run: a worker is killed, then the runner; the workers end by themselves; the next run resumes."""
    process = batch(fresh, "--engine", "pool", "--workers", "2")
    for line in process.stderr:
        if line.startswith("import "):
            break
    (victim, *others) = workers_of(process)
    os.kill(victim, signal.SIGKILL)
    for line in process.stderr:
        if line.startswith("fit "):
            break
    assert "failed" not in line
    others = workers_of(process)
    assert victim not in others
    process.kill()
    wait_for_end(others, 20)
    process.communicate()
    before = stamps(results_of(fresh))
    assert gbid("batch", fresh, "--engine", "serial") == 0
    after = stamps(results_of(fresh))
    assert {name: after[name] for name in before} == before
    assert table_of(fresh) == table_of(springs)
    assert left_over(results_of(fresh)) == []


@PROC
@pytest.mark.parametrize("line", ["import: 14 of 14", pytest.param("import: 14 to make", marks=pytest.mark.slow)])
def test_workers_end_within_two_seconds_of_ctrl_c(tmp_path, line):
    """Ctrl-C in a terminal goes to the runner and its workers, which are deaf to it."""
    path = write_springs(tmp_path, 14, fit="focus: simulation, multi_start: {starts: 3000}")  # minutes
    process = batch(path, "--engine", "pool", "--workers", "2", start_new_session=True)
    for text in process.stderr:
        if text.startswith(line):
            break
    time.sleep(0.2)
    workers = workers_of(process)
    assert {interrupts_blocked(pid) for pid in workers} == {True}
    os.killpg(process.pid, signal.SIGINT)
    wait_for_end(workers, 2)
    out, err = process.communicate(timeout=60)
    assert "Traceback" not in err
    assert out == ""
    assert process.returncode == 130, err
    assert err.splitlines()[-1] == "gbid: interrupted; complete results are kept"
    assert left_over(results_of(path)) == []
    assert gbid("check", path) == 0


def test_a_task_that_kills_its_workers_does_not_stop_the_rest(pool, job, tmp_path):
    kinds = {"a": files.write_number, "b": files.die, "c": files.write_number, "d": files.die_once}
    kinds |= {"e": files.refuse, "f": files.defect}
    watcher = files.Watcher()
    job = replace(job, reporter=watcher, engine=pool)
    job.experiment.results.mkdir()
    tasks = [task(tmp_path, item, write) for item, write in kinds.items()]
    a, b, c, d, e, f = run_tasks(job, tasks)
    assert watcher.seen[-1] == (6, 0)  # those that died are counted once
    assert (a.state, c.state, d.state) == ("made",) * 3
    assert (b.state, b.cause) == ("failed", "crash")
    assert f"died {ATTEMPTS} times (signal SIGKILL)" in b.text
    assert (e.cause, e.text) == ("data", "e is bad")
    assert f.cause == "defect"
    assert "ZeroDivisionError: oh" in f.text
    assert len(pool.process_ids) <= 2
    remembered = remembered_failure(job, tasks[5])
    assert "Traceback" in remembered.details
    again = run_tasks(job, tasks)
    assert [o.state for o in again] == ["kept", "failed", "kept", "kept", "failed", "failed"]
    assert [o.before for o in again] == [False, True, False, False, True, True]


def test_progress_counts_all_that_run(pool, job, tmp_path):
    """Two workers: two run until the last but one is done."""
    run_tasks(Job(job.experiment, engine=pool), [task(tmp_path / "both", item, files.meet) for item in "ab"])
    watcher = files.Watcher()
    tasks = [task(tmp_path, f"{i:x}", files.write_slowly) for i in range(1, 16)]
    run_tasks(replace(job, reporter=watcher, engine=pool), tasks)
    assert watcher.seen == [(i, min(2, 15 - i)) for i in range(1, 16)]


def test_a_full_disk_stops_a_pool(pool, job, tmp_path):
    tasks = [task(tmp_path, "a", files.full_disk), *(task(tmp_path, item, files.sleep) for item in "bcd")]
    began = time.monotonic()
    with pytest.raises(NoSpaceError, match="No space left for a"):
        run_tasks(Job(job.experiment, engine=pool), tasks)
    assert time.monotonic() - began < 30  # the worker that sleeps for a minute was ended
    made = run_tasks(Job(job.experiment, engine=pool), [task(tmp_path, "e", files.write_number)])
    assert made[0].state == "made"


def test_a_worker_is_warm_and_has_one_blas_thread(pool, job, tmp_path):
    tasks = [task(tmp_path, item, files.write_number) for item in "abcdef"]
    outcomes = run_tasks(Job(job.experiment, engine=pool), tasks)
    assert {int(o.text) for o in outcomes} <= set(pool.process_ids)
    assert os.getpid() not in pool.process_ids
    threads = Path(f"/proc/{pool.process_ids[0]}/task")
    assert not threads.exists() or len(list(threads.iterdir())) == 2  # the second one waits for the end of the runner


FILL_AND_RESUME = """
import contextlib, io, json, subprocess, sys
from pathlib import Path
from campaign_files import left_over, rows_of, stamps
from experiment_files import gbid

experiment, disk = Path(sys.argv[1]), Path(sys.argv[2])
disk.mkdir()
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=360k", "tmpfs", disk], check=True)
told = []
for size in ("size=360k", "size=20m"):
    subprocess.run(["mount", "-o", f"remount,{size}", disk], check=True)
    with contextlib.redirect_stderr(io.StringIO()) as err, contextlib.redirect_stdout(io.StringIO()):
        code = gbid("batch", experiment, "--engine", "serial", "--results", disk / "results")
    told.append([code, err.getvalue(), stamps(disk / "results"), [str(p) for p in left_over(disk)]])
print(json.dumps({"told": told, "rows": rows_of(disk / "results" / "table.csv")}))
"""


def may_mount():
    if not all(map(shutil.which, ("unshare", "mount"))):
        return False
    mount = ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return subprocess.run(mount, capture_output=True).returncode == 0


@pytest.mark.skipif(not may_mount(), reason="needs a file system of its own (unshare, mount)")
def test_a_disk_that_fills(springs, fresh):
    """A file system of 360 kB is full after some fits; with more room the rest is made."""
    script = [sys.executable, "-c", FILL_AND_RESUME, str(fresh), str(fresh.parent / "disk")]
    environment = {**files.ENVIRONMENT, "PYTHONPATH": os.pathsep.join([str(files.ROOT), str(SUPPORT)])}
    done = subprocess.run(["unshare", "-rm", *script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    (code, err, before, parts), (code_again, err_again, after, parts_again) = document["told"]
    assert code == 3, err
    assert "No space left in" in err.splitlines()[-1]
    assert "Traceback" not in err
    assert 0 < len(before) < 10
    assert code_again == 0, err_again
    assert {name: after[name] for name in before} == before
    assert document["rows"] == table_of(springs)
    assert parts == parts_again == []


def test_shards_at_the_same_time_then_collect(springs, fresh, capsys):
    for shard in ("1/2", "2/2"):
        with locked(results_of(fresh), shared=True):  # as by the other one
            assert gbid("batch", fresh, "--shard", shard, "--engine", "serial", "--json") == 0
        assert json.loads(capsys.readouterr().out)["stages"]["fit"]["made"] == 5
    assert not (results_of(fresh) / "table.csv").exists()
    assert gbid("batch", fresh, "--collect") == 0
    assert table_of(fresh) == table_of(springs)
    assert json_of(capsys, "batch", fresh)["stages"]["fit"]["kept"] == 10


def test_shards_share_staircases_but_not_stationary_recordings(tmp_path):
    from experiment_files import write_quick

    stairs = ("  prbs:", "  staircase: {steps: 2, hold_s: 0.1}\n  prbs:")
    job = Job(load_experiment(write_quick(tmp_path, stairs)))
    tasks, count = rig_tasks(job), 3
    parts = [tasks_of(Shard(i, count), job.experiment, tasks) for i in range(1, count + 1)]
    made = Counter(t.item.section for part in parts for t in part)
    assert set(made) == {t.item.section for t in tasks}
    planned = job.experiment.recordings
    assert {planned[name].kind for name in made} == {"excited", "stationary", "staircase"}
    for name, times in made.items():
        assert times == 1 or planned[name].stationary


LOOPS = """\
format: 1
name: loops
rig:
  operating_points: [{pressure_bar: 4.0, speed_rpm: 6000}, {pressure_bar: 5.0, speed_rpm: 0}]
  duration_s: 0.2
  prbs: {recordings: 1}
  loop: {structure: P, gains: {kappa_x: 1.2, kappa_y: 1.1}, recordings: 2, runout: offline}
  courses: [{name: down, duration_s: 0.2, pressure_bar: 4.0, speed_rpm: [6000.0, 500.0], coast_down: true}]
prefilter: {slow_roll: ["p4_*still1"]}
fits:
  together: {structure: plant, recordings: ["*prbs1"], together: true, left_out: {p4_n6000_prbs1: [[0.05, 0.1]]}}
  held: {structure: plant, options: {delay: exact}, loop: {}}
"""


def test_parts_contain_what_their_prefilter_needs(tmp_path):
    path = tmp_path / "loops.yaml"
    path.write_text(LOOPS)
    job = Job(load_experiment(path))
    made = {"down1": {"p4_n6000_still1"}, "p5_n0_loop2": {"p5_n0_loop_still1", "p5_n0_still1"}}
    for number in range(1, 6):
        tasks = [task for _, stage in early_tasks(job) for task in tasks_of(Shard(number, 5), job.experiment, stage)]
        items = {task.item.section for task in tasks if task.item.stage == "rig"}
        for prefiltered in (each.item.section for each in tasks if each.item.stage == "prefilter"):
            assert {prefiltered, *made.get(prefiltered, ())} <= items


def test_one_fit_is_that_of_the_batch(tmp_path):
    path = tmp_path / "loops.yaml"
    path.write_text(LOOPS)
    job = Job(load_experiment(path))
    complete = {task.item: task for _, tasks in early_tasks(job) for task in tasks}
    fits = [item for item in complete if item.stage == "fit"]
    assert len(fits) == 5
    for item in fits:
        tasks = [task for _, tasks in tasks_for(job, str(item)) for task in tasks]
        assert [task.item for task in tasks if task.item.stage == "fit"] == [item]
        assert all(complete[task.item].key == task.key for task in tasks)
    parts = tasks_for(job, "held/p5_n0_loop2")
    needed = {task.item.section for _, tasks in parts for task in tasks if task.item.stage == "rig"}
    assert needed == {"p5_n0_loop2", "p5_n0_loop_still1", "p5_n0_still1"}


def test_single_fits_at_the_same_time(springs, fresh, capsys):
    """Each in a process of its own, two of them with the same item, while a shard makes others."""
    items = json_of(capsys, "fit", fresh, "--list")["fits"]
    assert [Path(entry["path"]).stem for entry in items] == [f"run{i}" for i in range(1, 11)]
    assert printed_by(capsys, "fit", fresh, "--list").out.split() == [entry["item"] for entry in items]
    verbs = [("fit", fresh, "--one", item, "-q") for item in ("spring/run2", "spring/run2", "spring/run7")]
    verbs.append(("batch", fresh, "--shard", "2/5", "--engine", "serial", "-q"))  # run2 and run7 as well
    with locked(results_of(fresh), shared=True):
        started = [get_context("fork").Process(target=lambda verb: sys.exit(gbid(*verb)), args=(v,)) for v in verbs]
        for process in started:
            process.start()
        for process in started:
            process.join(60)
    assert [process.exitcode for process in started] == [0] * 4
    there = sorted(results_of(fresh).rglob("*.h5"))
    assert [file.stem for file in there] == ["run2", "run7"] * 2
    for i in (2, 7):
        ours, batched = (load(results_of(p) / "fits" / "spring" / f"run{i}.h5") for p in (fresh, springs))
        assert ours.parameters == batched.parameters
    assert left_over(results_of(fresh)) == []
    assert json_of(capsys, "batch", fresh)["stages"]["fit"] == {"made": 8, "kept": 2, "failed": 0, "not_converged": 0}
    assert table_of(fresh) == table_of(springs)


def test_a_single_fit_reads_no_other_recording(tmp_path, capsys, monkeypatch):
    fresh = write_springs(tmp_path, 3)
    assert gbid("import", fresh) == 0
    read = []
    monkeypatch.setattr(
        "gbid.experiment.recordings.digest_or_not", lambda path: read.append(path.stem) or digest_or_not(path)
    )
    assert json_of(capsys, "fit", fresh, "--one", "spring/run3")["fits"][0]["model"] == "run3"
    assert set(read) == {"run3"}


def test_single_fits_that_fail(tmp_path, capsys):
    path = write_springs(tmp_path, 3, fit="focus: simulation, max_iterations: 1", damage={2: bad})
    for item, code, words in [
        ("spring/run1", 4, "fit spring/run1: "),
        ("spring/run2", 3, "import run2: "),
        ("spring/run4", 2, "--one spring/run4: no such fit; did you mean 'spring/run"),
        ("spring", 2, "--one spring: no such fit"),
    ]:
        assert words in printed_by(capsys, "fit", path, "--one", item, code=code).err
    for wrong in (["--list"], ["--only", "spring"], ["--dry-run"], ["--engine", "pool"], ["--one", "spring/run1"]):
        assert gbid("fit", path, "--one", "spring/run3", *wrong) == 2
    with locked(results_of(path)):
        assert gbid("fit", path, "--one", "spring/run3") == 2
    assert {file.stem for file in results_of(path).rglob("*.h5")} == {"run1"}


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "1/0"])
def test_wrong_shards(text):
    with pytest.raises(UsageError, match="i/n"):
        read_shard(text)


def bad(columns):
    columns["position [um]"][7] = np.inf


def test_failures_are_listed_kept_and_retried(tmp_path, capsys):
    path = write_springs(tmp_path, 4, damage={2: bad})
    err = printed_by(capsys, "batch", path, "--engine", "serial", code=3).err
    assert "gbid: error: import run2: " in err
    assert "sample 7" in err
    table = load(results_of(path) / "table.h5")
    assert table.success.sum() == 3
    assert not table.success[1]
    assert "failed: import run2: " in table.status[1]
    assert np.isnan(table.values[1]).all()
    assert table_of(path)[1]["k"] == ""
    record = results_of(path) / "failed" / "import" / "run2.json"
    before = record.read_bytes()
    assert gbid("batch", path) == 3  # not tried again
    assert "(failed in an earlier run; use --retry to try again)" in capsys.readouterr().err
    assert record.read_bytes() == before
    assert "failed before" not in printed_by(capsys, "batch", path, "--retry", code=3).err
    write_spring_data(tmp_path / "data" / "run2.csv", 2, n=400)  # other data: tried without being asked
    assert gbid("batch", path) == 0
    assert not record.exists()
    assert load(results_of(path) / "table.h5").success.all()


def test_what_has_nothing_to_start_from_is_not_run(tmp_path):
    path = write_springs(tmp_path, 3, damage={2: bad})
    with working(load_experiment(path), engine="serial") as job:
        outcomes = {f"{o.item.stage} {o.item}": o for o in run_campaign(job)}
    assert outcomes["fit spring/run2"].text == "its input is missing: import run2 failed"
    assert outcomes["fit spring/run2"].cause == "input"
    assert not (results_of(path) / "failed" / "fit").exists()
    (results_of(path) / "recordings" / "run3.h5").write_bytes(b"damaged")
    with working(load_experiment(path), engine="serial") as job:
        outcomes = {f"{o.item.stage} {o.item}": o for o in run_campaign(job)}
    assert outcomes["import run3"].state == "failed"
    assert outcomes["fit spring/run3"].state == "kept"  # it is there, made from what the file should hold


@pytest.mark.parametrize("damage", [None, {i: bad for i in range(1, 15)}])
def test_progress_of_many(tmp_path, damage, capsys):
    path = write_springs(tmp_path, 14, damage=damage)
    assert gbid("batch", path, "--engine", "serial") == (3 if damage else 0)
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert lines[0] == "import: 14 to make"
    if damage is None:
        assert len(lines) == 7
        assert lines[-1].startswith("next: gbid ")
        assert lines[1].startswith("import: 14 of 14 done")
        assert re.fullmatch(r"fit: 14 of 14 done, \d+ s, worst fit 9\d\.\d % \(spring/run\d+\)", lines[3])
    else:
        assert sum(line.startswith("import run") for line in lines) == 10  # the first ones at once
        assert sum(line.startswith("gbid: error: import run") for line in lines) == 11  # ten, and the first as the last
        assert "gbid: error: 3 more failed; `--json` lists all" in lines
        assert re.search(r"^spring +14 +0 +14", captured.out, re.MULTILINE)


def test_an_item_that_does_not_converge_is_in_the_table(tmp_path):
    path = write_springs(tmp_path, 2, fit="focus: simulation, max_iterations: 1")
    assert gbid("batch", path) == 4
    table = load(results_of(path) / "table.h5")
    assert not table.success.any()
    assert np.isfinite(table.values).all()


def test_two_runners(fresh, capsys):
    with locked(results_of(fresh)):
        for verb in ("batch", "run", "fit", "import"):
            assert f"process {os.getpid()} on " in printed_by(capsys, verb, fresh, code=2).err
        assert gbid("batch", fresh, "--shard", "1/2") == 2
    assert left_over(results_of(fresh)) == []
    shared = locked(results_of(fresh), shared=True)
    with shared, locked(results_of(fresh), shared=True), pytest.raises(UsageError), locked(results_of(fresh)):
        pass
    assert left_over(results_of(fresh)) == []


def test_stale_temporary_files_of_ours_are_removed(tmp_path):
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    from gbid.core.files import _host, _prefix

    dead = int(ended.stdout)
    names = {
        f".a.h5.{_host()}~{dead}.x.part": True,
        f".a.h5.{_host()}~{os.getpid()}.x.part": False,
        f"{_prefix('a.h5')}x.part": False,
        f".a.h5.{_host()}~{os.getpid()}-1.x.part": True,  # of another process that had this number
        f".a.h5.elsewhere~{dead}.x.part": False,
        ".download.part": False,
        "mine.part": False,
    }
    for name in names:
        (tmp_path / name).write_text("")
    old = tmp_path / ".b.h5.elsewhere~1.x.part"
    old.write_text("")
    os.utime(old, (1e9, 1e9))
    removed = {path.name for path in remove_stale_parts(tmp_path)}
    assert removed == {old.name, *(name for name, stale in names.items() if stale)}


@PROC
def test_temporary_files_of_a_process_that_ended_unnoticed_are_stale(tmp_path):
    code = "import sys; from gbid.core.files import _prefix; print(_prefix('a.h5'), flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes, text=True) as child:
        part = tmp_path / f"{child.stdout.readline().strip()}x.part"
        part.write_text("")
        assert remove_stale_parts(tmp_path) == []
        child.kill()
        while alive(child.pid):  # the child waits for this process to take note of its end
            time.sleep(0.01)
        assert remove_stale_parts(tmp_path) == [part]


def test_engines_by_name():
    assert isinstance(make_engine("serial"), InTurn)
    with contextlib.closing(make_engine("auto", 3)) as engine:
        assert (engine.n_workers, engine.fewest) == (3, FEW)
    for arguments in (("serail",), ("pool", 0), ("serial", 2), ("serial", None, "tcp://a:1"), ("dask", 2, "tcp://a:1")):
        with pytest.raises(UsageError):
            make_engine(*arguments)


def test_options_that_do_not_go_together(fresh, capsys):
    assert gbid("batch", fresh, "--collect", "--retry") == 2
    assert gbid("batch", fresh, "--collect", "--workers", "2") == 2
    assert gbid("batch", fresh, "--engine", "serial", "--workers", "2") == 2
    assert gbid("batch", fresh, "--shard", "5/4") == 2
    assert "choose auto, serial, pool, dask" in printed_by(capsys, "batch", fresh, "--engine", "threads", code=2).err
    assert not (results_of(fresh) / "fits").exists()


def test_a_table_of_others_is_left_and_nothing_made_is_said(tmp_path):
    """The row of a fit to all recordings has the conditions that these share."""
    job = Job(load_experiment(write_springs(tmp_path, 2, fit="together: true")))
    table, outcomes = collect(job)
    assert (len(table), len(outcomes)) == (1, 2)
    assert not table.success.any()
    assert NOT_MADE in table.status[0]
    assert table.speed_rpm[0] == 0
    assert np.isnan(table.pressure_bar[0])
    again, outcomes = collect(job)
    assert {outcome.state for outcome in outcomes} == {"kept"}
    assert len(again) == len(load(job.path("", "table", ending=".h5"))) == 1
    table_path = job.path("", "table", ending=".csv")
    table_path.write_text("of someone else")
    assert [outcome.state for outcome in collect(job)[1]] == ["kept", "failed"]
    assert table_path.read_text() == "of someone else"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not list threads there")
def test_a_runner_is_forked_only_while_it_has_one_thread():
    code = """\
import threading
from gbid.experiment.engines import _has_one_thread
gate = threading.Event()
waiting = threading.Thread(target=gate.wait)
print(_has_one_thread())
waiting.start()
print(_has_one_thread())
gate.set()
"""
    environment = {**os.environ, **dict.fromkeys(ONE_THREAD, "1")}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["True", "False"]
