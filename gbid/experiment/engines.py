"""Engines that run the tasks of a stage: this process, a pool of worker processes, or Dask."""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import signal
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from itertools import count
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from ruamel.yaml.comments import CommentedMap

from gbid.core.errors import DataError, GbidError, NoSpaceError, UsageError
from gbid.core.yaml_file import YamlFile
from gbid.experiment.run import Failure, InTurn, Job, Outcome, Task, TaskEngine, fail, perform, standing

if TYPE_CHECKING:
    from distributed import Client

# ---- Worker process: it runs the tasks that it receives through a pipe.

READY = "ready"
"""First message of a worker: it can run tasks."""


def serve(connection: Connection) -> None:
    """Run tasks that arrive through a pipe until the pipe is closed.

    A message is a job (pickled), which is used for the following tasks, or a task with its number. The worker answers a
    task with its number and the result of `attempt`. It ignores Ctrl-C, because the runner stops its workers. When the
    runner is gone, it ends at once, also in the middle of a task: results appear only when they are complete.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in signal.valid_signals() - {signal.SIGINT}:
        if callable(signal.getsignal(number)):  # a fork has the handlers of the runner
            signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_end_with_runner, daemon=True).start()
    collect_less()
    job: Any = None
    with contextlib.suppress(EOFError, OSError):  # the runner has ended
        connection.send(READY)
        while True:
            message = connection.recv()
            if isinstance(message, bytes):
                job = pickle.loads(message)
            else:
                number, task = message
                connection.send((number, attempt(job, task)))


def collect_less() -> None:
    """Exclude all present objects from garbage collection, and collect less often.

    Symbols and pictures are many objects, few of them garbage: a fit takes 6 % less.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def _end_with_runner() -> None:
    """Wait for the end of the parent process, then end this process."""
    runner = parent_process()
    if runner is not None:
        wait([runner.sentinel])
        os._exit(1)


def bare_job(job: Job) -> Job:
    """Return a job that can be sent to other processes: absolute paths, no YAML positions, no reporter."""
    experiment = job.experiment
    file = YamlFile(experiment.file.path.resolve(), {}, CommentedMap())
    bare = replace(experiment, file=file, results=experiment.results.resolve())
    vars(bare)["recordings"] = experiment.recordings  # searched once: the files of a folder may change
    return Job(bare, job.overwrite, retry=job.retry, command=job.command)


def bare_task(task: Task) -> Task:
    """Return a task with an absolute path."""
    return replace(task, path=Path(task.path).resolve())


def attempt(job: Job, task: Task) -> Outcome | str:
    """Run a task in a worker and return its outcome.

    Returns
    -------
    Outcome or str
        Outcome, or the text of the error when the disk is full. A result that a worker completed just before it died
        counts as made.
    """
    try:
        return completed(job, task) or perform(job, task)
    except NoSpaceError as error:
        return str(error)


def completed(job: Job, task: Task) -> Outcome | None:
    """Return the outcome of a task that a worker completed just before it died; None for unfinished tasks."""
    outcome = standing(job, task) if task.path.exists() else None
    return replace(outcome, state="made") if outcome is not None and outcome.state == "kept" else None


def outcome_of(answer: Outcome | str) -> Outcome:
    """Return the outcome in the answer of a worker.

    Raises
    ------
    NoSpaceError
        When the disk is full.
    """
    if isinstance(answer, str):
        raise NoSpaceError(answer)
    return answer


# ---- Pool of worker processes on this machine.

ATTEMPTS = 3
"""Number of times that a task may kill its worker before it counts as failed."""

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_OF_WORKERS = {**dict.fromkeys(ONE_THREAD, "1"), "PYTHONSAFEPATH": "1"}  # no module comes from the current folder
_OF_FITS = ("gbid.identify.fitting", "scipy.fft", "scipy.sparse.linalg", "scipy.special")  # imported by their first use
_PATIENCE = 3.0  # longest time for a worker to end [s]


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    connection: Connection
    ready: bool = False
    number: int | None = None  # of the task that it runs

    def send(self, message: object) -> None:
        with contextlib.suppress(OSError):  # a dead worker is noticed when its pipe is read
            self.connection.send(message)


class ProcessPool:
    """Engine of worker processes with one BLAS thread each; they run from the first task until `close`.

    A runner without other threads is forked, which costs nothing. Otherwise processes are spawned, and each loads gbid.

    A task whose worker dies is given to another worker, up to `ATTEMPTS` times in all. Then it has failed.

    Parameters
    ----------
    n_workers : int
        Largest number of processes.
    fewest : int
        Smallest number of tasks for which processes are started; before that, fewer tasks run in this process.
    """

    def __init__(self, n_workers: int, fewest: int = 1) -> None:
        self.n_workers, self.fewest = n_workers, fewest
        self._workers: list[_Worker] = []

    @property
    def process_ids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in self._workers if worker.process.pid is not None]

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield index and outcome of each, as in `gbid.experiment.run.TaskEngine`.

        Raises
        ------
        NoSpaceError
            When the disk is full.
        GbidError
            When no worker can be started.
        """
        if len(tasks) < self.fewest and not self._workers:
            yield from InTurn().outcomes(job, tasks)
            return
        shipped = pickle.dumps(bare_job(job))
        for worker in self._workers:
            worker.send(shipped)
        waiting, deaths, failed_starts = deque(range(len(tasks))), Counter[int](), 0

        def give(worker: _Worker) -> None:
            if waiting and worker.ready and worker.number is None:
                worker.number = waiting.popleft()
                job.reporter.begin(tasks[worker.number].item)
                worker.send((worker.number, bare_task(tasks[worker.number])))

        try:
            while busy := len(waiting) + sum(worker.number is not None for worker in self._workers):
                self._start(min(self.n_workers, busy), shipped)
                for worker in self._workers:
                    give(worker)
                readable = wait([worker.connection for worker in self._workers])  # messages, and ends of processes
                for worker in [worker for worker in self._workers if worker.connection in readable]:
                    number = worker.number
                    try:
                        message = worker.connection.recv()
                    except (EOFError, OSError):
                        how = self._bury(worker)
                        if number is None:
                            failed_starts += not worker.ready
                            if failed_starts == ATTEMPTS:
                                raise GbidError(f"worker processes cannot start ({how}); try --engine serial") from None
                            continue
                        deaths[number] += 1
                        outcome = _after_death(job, tasks[number], deaths[number], how)
                        if outcome is None:
                            waiting.append(number)
                        else:
                            yield number, outcome
                        continue
                    if message == READY:
                        worker.ready, failed_starts = True, 0
                        continue
                    number, answer = message
                    outcome, worker.number = outcome_of(answer), None
                    give(worker)  # before the outcome is processed, so that the worker need not wait for that
                    yield number, outcome
        finally:
            self._stop([worker for worker in self._workers if worker.number is not None])

    def close(self) -> None:
        """Stop the workers."""
        self._stop(list(self._workers))

    def _start(self, count: int, shipped: bytes) -> None:
        context: Any = get_context("fork" if _has_one_thread() else "spawn")
        for name in _OF_FITS if count > len(self._workers) and context.get_start_method() == "fork" else ():
            import_module(name)  # once for all workers
        for _ in range(count - len(self._workers)):
            parent_end, child_end = context.Pipe()
            process = context.Process(target=serve, args=(child_end,), daemon=True, name="gbid worker")
            with _environment(_OF_WORKERS), _without_interrupts():
                process.start()
            child_end.close()
            self._workers.append(_Worker(process, parent_end))
            self._workers[-1].send(shipped)

    def _bury(self, worker: _Worker) -> str:
        """Remove a dead worker; return its signal or exit code as text."""
        self._workers.remove(worker)
        worker.connection.close()
        worker.process.join(_PATIENCE)
        code = worker.process.exitcode or 0
        return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def _stop(self, workers: list[_Worker]) -> None:
        for worker in workers:
            worker.process.terminate()
            worker.connection.close()
            self._workers.remove(worker)
        for worker in workers:
            worker.process.join(_PATIENCE)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()


def _after_death(job: Job, task: Task, times: int, how: str) -> Outcome | None:
    """Return the outcome of a task whose worker died; None if the task will be retried."""
    outcome = completed(job, task)
    if outcome is not None or times < ATTEMPTS:
        return outcome
    text = f"its process died {times} times ({how}); the usual reason for SIGKILL is too little memory"
    return fail(job, task, Failure(task.key, "crash", text))


def _has_one_thread() -> bool:
    """Return whether this process has a single thread, so that no other thread can hold a lock (Linux only)."""
    try:
        return len(list(Path("/proc/self/task").iterdir())) == 1
    except OSError:
        return False


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C for processes started in this context, because a terminal sends it to all of them."""
    if not hasattr(signal, "pthread_sigmask"):  # missing on some systems
        yield
        return
    resource_tracker.ensure_running()  # else the first process starts it, which unblocks Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes started in this context."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# ---- Dask engine: workers of a cluster, which must see the results folder under an equal path.

_DASK_PATIENCE = 10.0  # longest time for a scheduler to answer [s]
_JOURNEYS, _LARGEST = 20, 16  # submissions per thread, for many tasks; largest number of tasks in one
_CALM = {  # Dask's own monitoring, which takes over a third of the time of short fits
    "distributed.worker.profile.enabled": False,  # a tenth of the time
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    # Dask's default contains MALLOC_TRIM_THRESHOLD_, with which each larger array is allocated anew by the system.
    "distributed.nanny.pre-spawn-environ": _OF_WORKERS,
}
_TRIED_AGAIN = "tried again, because the Dask worker that had it was lost"
_one_at_a_time = threading.Lock()  # in each worker process: the solver is not thread-safe


class DaskEngine:
    """Engine that runs tasks on a Dask scheduler, or on a Dask cluster of processes on this machine.

    Parameters
    ----------
    scheduler : str or distributed.Client, optional
        Address of the scheduler, ``tcp://host:port``, or a client, which stays open. Without either, workers are
        started on this machine.
    n_workers : int
        Number of workers to start on this machine.

    Raises
    ------
    UsageError
        When Dask is not installed, the scheduler does not answer, or the client is closed or asynchronous.
    GbidError
        When no workers can be started on this machine.
    """

    def __init__(self, scheduler: str | Client | None, n_workers: int) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise UsageError("Dask is not installed; install it with: pip install 'gbid[dask]'") from None
        self._cluster = _local_cluster(n_workers) if scheduler is None else None
        self._is_ours = scheduler is None or isinstance(scheduler, str)
        if not self._is_ours:
            self.client = _running_client(scheduler, Client)
            return
        try:
            self.client = Client(self._cluster or scheduler, timeout=_DASK_PATIENCE)
        except (OSError, ValueError) as error:
            text = f"no Dask scheduler answers at {scheduler}: {' '.join(str(error).split())}"
            raise UsageError(f"{text}; start it, or correct the address") from None

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield index and outcome of each, as in `gbid.experiment.run.TaskEngine`.

        As many tasks are reported as begun as there are threads: workers do not say which task they run. The reporter
        is told of each lost worker with the items that it had; these run on another worker, and their outcomes say so.
        For that the client subscribes to the scheduler's topic ``all``.

        Raises
        ------
        NoSpaceError
            When the disk is full.
        DataError
            When the workers write to another results folder than that of this process.
        UsageError
            When the connection to the scheduler is lost.
        """
        from distributed import CancelledError, as_completed
        from distributed.scheduler import KilledWorker

        shipped, threads = pickle.dumps(bare_job(job)), max(1, sum(self.client.nthreads().values()))
        waiting, running = dict.fromkeys(range(len(tasks))), set[int]()
        sent, answered = {}, as_completed()
        chunk_of, tried_again = dict[Any, Sequence[int]](), set[int]()
        events, lost = deque[Any](), count(1)  # events come in another thread

        def submit(chunk: Sequence[int]) -> None:
            shipment = [bare_task(tasks[number]) for number in chunk]
            future = self.client.submit(_attempt_there, shipped, shipment, self._cluster is not None, pure=False)
            sent[future] = chunk_of[future.key] = chunk
            answered.add(future)

        def tell_losses() -> None:
            while events:
                _, event = events.popleft()
                if event.get("action") != "remove-worker":
                    continue
                numbers = sorted(number for key in event["processing-tasks"] for number in chunk_of.get(key, ()))
                if numbers:
                    tried_again.update(numbers)
                    job.reporter.lose([tasks[number].item for number in numbers], next(lost))

        def outcome_of_answer(number: int, answer: Outcome | str | None) -> Outcome:
            if answer is None:
                return _crashed(job, tasks[number])
            outcome = _checked(answer, tasks[number])
            again = number in tried_again and outcome.state == "made"
            return replace(outcome, text="; ".join(filter(None, [_TRIED_AGAIN, outcome.text]))) if again else outcome

        def begin(number: int) -> None:
            del waiting[number]
            running.add(number)
            job.reporter.begin(tasks[number].item)

        def begin_next(ended: int | None = None) -> None:
            if ended in waiting:
                begin(ended)
            running.discard(ended)
            while waiting and len(running) < threads:
                begin(next(iter(waiting)))

        size = min(_LARGEST, max(1, len(tasks) // (threads * _JOURNEYS)))
        try:
            self.client.subscribe_topic("all", events.append)
            for first in range(0, len(tasks), size):  # all at once: workers that join later take their share
                submit(range(len(tasks))[first : first + size])
            begin_next()
            for future in answered:
                chunk, error = sent.pop(future), future.exception()
                tell_losses()
                if isinstance(error, KilledWorker) and len(chunk) > 1:
                    for number in chunk:  # one of them killed it; finished ones are kept
                        submit([number])
                    continue
                if error is not None and not isinstance(error, KilledWorker):
                    raise error
                for number, answer in zip(chunk, [None] if error else future.result(), strict=True):
                    begin_next(number)
                    yield number, outcome_of_answer(number, answer)
        except (OSError, CancelledError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            text = f"the connection to the Dask scheduler is lost ({why})"
            raise UsageError(f"{text}; start it and run again; complete results stay") from None
        finally:
            with contextlib.suppress(OSError, CancelledError):  # when the scheduler or a worker has just ended
                self.client.unsubscribe_topic("all")
                self.client.cancel(list(sent))

    def close(self) -> None:
        """Disconnect from the scheduler and stop workers that this engine started; a given client stays open."""
        if self._is_ours:
            self.client.close()
        if self._cluster is not None:
            self._cluster.close()


def _running_client(given: Any, kind: type) -> Any:
    """Return a Dask client of the user; refuse a client that cannot run tasks."""
    if not isinstance(given, kind):
        raise UsageError(f"scheduler = {given!r}; give its address, such as tcp://host:8786, or a Dask client")
    client: Any = given
    if client.status != "running" or client.asynchronous:
        text = "is not connected" if client.status != "running" else "is asynchronous"
        raise UsageError(f"the Dask client {text}; give a running Client(...) without asynchronous=True")
    return client


def _crashed(job: Job, task: Task) -> Outcome:
    text = "the Dask workers that ran it died; the usual reason is too little memory"
    return fail(job, task, Failure(task.key, "crash", text))


def _checked(answer: Outcome | str, task: Task) -> Outcome:
    outcome = outcome_of(answer)
    if outcome.state == "made" and not task.path.exists():
        text = "a Dask worker made it, but it is missing here; workers must see the same results folder"
        raise DataError(f"{task.path}: {text}")
    return outcome


def _local_cluster(n_workers: int) -> Any:
    """Return a Dask cluster on this machine; retry if a worker dies at its start."""
    import dask
    from distributed import LocalCluster

    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    for left in reversed(range(ATTEMPTS)):
        try:
            with dask.config.set(_CALM), _environment(_OF_WORKERS):
                return LocalCluster(n_workers=n_workers, **options)
        except RuntimeError as error:
            if not left:
                text = f"Dask workers cannot start ({' '.join(str(error).split())}); try --engine pool"
                raise GbidError(text) from None
    raise AssertionError


def _attempt_there(shipped: bytes, tasks: list[Task], alone: bool) -> list[Outcome | str]:
    job = _job_in(shipped, alone)
    with _one_at_a_time:
        return [attempt(job, task) for task in tasks]


@lru_cache(maxsize=1)
def _job_in(shipped: bytes, alone: bool) -> Job:
    """Return the job that a worker received; with `alone`, the worker process runs only gbid tasks."""
    if alone:
        collect_less()
    job: Job = pickle.loads(shipped)
    return job


# ---- Engine by its name.

EngineName = Literal["auto", "serial", "pool", "dask"]

FEW = 8
"""Smallest number of tasks of a stage for which worker processes are started."""


def make_engine(name: str = "auto", workers: int | None = None, scheduler: str | Client | None = None) -> TaskEngine:
    """Return the engine of a given name.

    Parameters
    ----------
    name : {"auto", "serial", "pool", "dask"}
        "serial" is this process; "pool" is a pool of processes on this machine; "auto" is this process for a few tasks
        and the pool for many.
    workers : int, optional
        Number of processes; the default is the number of processors that this process may use.
    scheduler : str or distributed.Client, optional
        Address of a Dask scheduler, or a running client.

    Returns
    -------
    TaskEngine
        The engine; close it after use.

    Raises
    ------
    UsageError
        When the name is unknown, the options contradict each other, or the scheduler does not answer.
    """
    if name not in get_args(EngineName):
        raise UsageError(f"engine {name!r}; choose {', '.join(get_args(EngineName))}")
    if workers is not None and workers < 1:
        raise UsageError(f"{workers} workers; give at least 1")
    if scheduler is not None and name not in ("auto", "dask"):
        raise UsageError(f"a scheduler is for the engine dask, not {name}; leave one of the two out")
    if scheduler is not None and workers is not None:
        raise UsageError("a scheduler has its own workers; leave the number of workers out")
    if workers is not None and name == "serial":
        raise UsageError("the engine 'serial' has no workers; leave the number of workers out, or choose 'pool'")
    affinity = getattr(os, "sched_getaffinity", None)  # missing on some systems
    count = workers or (len(affinity(0)) if affinity else os.cpu_count() or 1)
    if name == "dask" or scheduler is not None:
        return DaskEngine(scheduler, count)
    if name == "serial":
        return InTurn()

    return ProcessPool(count, 1 if name == "pool" else FEW)
