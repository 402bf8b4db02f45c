"""A campaign on Dask: two local workers, of which one is killed."""

import os
import signal
import sys
from dataclasses import replace
from itertools import count
from pathlib import Path

import campaign_files as files
import pytest
from campaign_files import left_over, rows_of, task, write_springs
from experiment_files import gbid

from gbid.core.errors import GbidError, NoSpaceError, UsageError
from gbid.experiment.campaign import run_campaign, working
from gbid.experiment.engines import ATTEMPTS, make_engine
from gbid.experiment.load import load_experiment
from gbid.experiment.run import Job, run_tasks

distributed = pytest.importorskip("distributed", reason="distributed is not installed (gbid[dask])")
WorkerPlugin, CommClosedError = distributed.WorkerPlugin, distributed.comm.CommClosedError
FOLDER = str(Path(files.__file__).parent)
pytestmark = [pytest.mark.filterwarnings("ignore:.*:ResourceWarning"), pytest.mark.filterwarnings("ignore:unclosed")]


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    executed = files.poison(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)  # where workers start
        made = make_engine("dask", 2)
    yield made
    made.close()
    assert executed.read_text() == "", "Python files beside the data are executed"


class FindTasks(WorkerPlugin):
    """Lets workers, also those that come later, import the tasks of the tests."""

    def setup(self, worker):
        sys.path.insert(0, FOLDER)


class KillWorker(WorkerPlugin):
    """Kills the worker that starts the sixth task: of four imports and four fits, the second fit."""

    def __init__(self, folder):
        self.folder = folder

    def transition(self, key, start, finish, **_):
        if finish == "executing" and next(number for number in count(1) if self.takes(number)) == 6:
            os.kill(os.getpid(), signal.SIGKILL)

    def takes(self, number):
        """Whether this worker makes the file of a start; one of two workers makes it."""
        try:
            (self.folder / str(number)).touch(exist_ok=False)
        except FileExistsError:
            return False
        return True


class Listener:
    """A reporter that keeps the lost workers."""

    def __init__(self):
        self.lost = []

    def expect(self, stage, todo, there, failed):
        pass

    def begin(self, item):
        pass

    def lose(self, items, count):
        self.lost.append((count, *items))

    def end(self, outcome):
        pass


def test_one_of_two_workers_is_killed(engine, tmp_path):
    one, two = (write_springs(tmp_path / name, 4) for name in ("one", "two"))
    assert gbid("batch", one, "--engine", "serial") == 0
    (tmp_path / "starts").mkdir()
    engine.client.register_plugin(KillWorker(tmp_path / "starts"), name="kill-worker")
    listener = Listener()
    with working(load_experiment(two), engine="serial") as job:
        outcomes = run_campaign(Job(job.experiment, reporter=listener, engine=engine))
    engine.client.unregister_worker_plugin("kill-worker")
    engine.client.wait_for_workers(2)
    assert [o.state for o in outcomes] == ["made"] * 8
    ((number, *items),) = listener.lost
    assert number == 1
    assert {o.item for o in outcomes if o.text.startswith("tried again")} == set(items) != set()
    assert gbid("batch", two, "--collect") == 0
    tables = [rows_of(path.parent / "results" / "springs" / "table.csv") for path in (one, two)]
    assert tables[0] == tables[1]
    assert left_over(two.parent / "results") == []


def test_a_scheduler_by_its_address(engine, tmp_path, capsys):
    path = write_springs(tmp_path, 3)
    assert gbid("batch", path, "--scheduler", engine.client.scheduler_info()["address"]) == 0
    assert capsys.readouterr().err.count("has no encryption and no password") == 1
    assert len(rows_of(tmp_path / "results" / "springs" / "table.csv")) == 3


def test_a_client_of_ones_own_stays_open(engine, tmp_path):
    with working(load_experiment(write_springs(tmp_path, 3)), scheduler=engine.client) as job:
        outcomes = run_campaign(job)
    assert [o.state for o in outcomes] == ["made"] * 6
    assert engine.client.status == "running"
    assert engine.client.submit(os.getpid).result() != os.getpid()
    with pytest.raises(UsageError, match="its own workers"):
        make_engine("auto", 2, engine.client)
    closed = distributed.Client(engine.client.scheduler.address)
    closed.close()
    with pytest.raises(UsageError, match="scheduler = 8786; give its address"):
        make_engine(scheduler=8786)
    with pytest.raises(UsageError, match="is not connected"):
        make_engine(scheduler=closed)


@pytest.fixture
def job(engine, tmp_path):
    engine.client.register_plugin(FindTasks(), name="find-tasks")
    return Job(load_experiment(write_springs(tmp_path, 2), tmp_path / "results"), engine=engine)


def test_failures_of_tasks_are_outcomes(job, tmp_path):
    kinds = {"a": files.write_number, "e": files.refuse, "f": files.defect}
    a, e, f = run_tasks(job, [task(tmp_path, item, write) for item, write in kinds.items()])
    assert (a.state, e.cause, f.cause) == ("made", "data", "defect")
    with pytest.raises(NoSpaceError):
        run_tasks(job, [task(tmp_path, "b", files.full_disk)])


def test_progress_counts_one_for_each_thread(job, tmp_path):
    watcher = files.Watcher()
    tasks = [task(tmp_path, f"{i:x}", files.write_number) for i in range(16)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbid.experiment.engines._JOURNEYS", 2)  # four tasks travel together
        run_tasks(replace(job, reporter=watcher), tasks)
    assert [done for done, _ in watcher.seen] == list(range(1, 17))
    assert all(running <= 2 for _, running in watcher.seen)
    assert watcher.seen[0][1] == 2
    assert watcher.seen[-1] == (16, 0)


def test_workers_that_join_later_find_all_tasks_with_the_scheduler(job, tmp_path, monkeypatch):
    client, submitted, seen = job.engine.client, [], []
    submit = client.submit
    monkeypatch.setattr(client, "nthreads", dict)  # as of a cluster whose jobs still wait in a queue
    monkeypatch.setattr(client, "submit", lambda *args, **options: submitted.append(args) or submit(*args, **options))
    watcher = files.Watcher()
    monkeypatch.setattr(watcher, "end", lambda _: seen.append(len(submitted)))
    run_tasks(replace(job, reporter=watcher), [task(tmp_path, f"{i:x}", files.write_number) for i in range(8)])
    assert seen == [8] * 8


@pytest.mark.slow
def test_a_task_that_kills_its_workers_does_not_stop_the_others_of_its_journey(job, tmp_path):
    tasks = [task(tmp_path, f"{i:x}", files.write_number) for i in range(16)]
    tasks[3] = task(tmp_path, "3", files.die)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gbid.experiment.engines._JOURNEYS", 2)  # four tasks travel together
        outcomes = run_tasks(job, tasks)
    assert [o.state for o in outcomes] == ["made"] * 3 + ["failed"] + ["made"] * 12
    assert outcomes[3].cause == "crash"


def test_no_scheduler_answers(monkeypatch):
    monkeypatch.setattr("gbid.experiment.engines._DASK_PATIENCE", 0.5)
    with pytest.raises(UsageError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        make_engine("dask", scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize("deaths", [1, ATTEMPTS])
def test_workers_that_die_before_they_have_begun(deaths, monkeypatch):
    """Dask says of them that a nanny failed to start."""
    started = []

    def start(**options):
        started.append(options["n_workers"])
        if len(started) <= deaths:
            raise RuntimeError("Nanny failed to start.")
        return "cluster"

    monkeypatch.setattr("distributed.LocalCluster", start)
    monkeypatch.setattr("distributed.Client", lambda cluster, timeout: cluster)
    if deaths < ATTEMPTS:
        assert make_engine("dask", 2).client == "cluster"
    else:
        with pytest.raises(GbidError, match=r"cannot start \(Nanny failed to start\.\); try --engine pool"):
            make_engine("dask", 2)
    assert started == [2] * min(deaths + 1, ATTEMPTS)


def test_a_scheduler_that_is_lost(job, tmp_path, monkeypatch):
    class Lost:
        def add(self, future):
            pass

        def __iter__(self):
            raise CommClosedError("the stream\nis closed")

    monkeypatch.setattr("distributed.as_completed", Lost)
    with pytest.raises(UsageError, match=r"scheduler is lost \(the stream is closed\); start it and run again"):
        run_tasks(job, [task(tmp_path, "a", files.write_number)])
