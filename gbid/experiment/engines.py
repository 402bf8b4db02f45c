"""Engines that run the tasks of a stage: this process, a pool of worker processes, or Dask."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import os
import pickle
import signal
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
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


def serve(connection: Connection) -> None:
    """Run tasks until the pipe is closed.

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
    connection.send(READY)
    job = None
    try:
        while True:
            message = connection.recv()
            if isinstance(message, bytes):
                job = pickle.loads(message)
            else:
                number, task = message
                assert job is not None
                connection.send((number, attempt(job, task)))
    except (EOFError, OSError):  # the runner has ended
        return


def collect_less() -> None:
    """Leave what there is, as all that was imported, out of each collection of garbage, and collect less often.

    Symbols and pictures are many objects, few of them garbage: a fit takes 6 % less.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def _end_with_runner() -> None:
    """Wait until the process that started this one has ended, and end this one."""
    runner = parent_process()
    if runner is not None:
        wait([runner.sentinel])
        os._exit(1)


# ---- Forms of job and task for other processes: without positions and reporter, with absolute paths.


def bare_job(job: Job) -> Job:
    """Return the job for worker processes: absolute paths, no positions in the YAML, no reporter."""
    experiment = job.experiment
    file = YamlFile(experiment.file.path.resolve(), {}, CommentedMap())
    bare = replace(experiment, file=file, results=experiment.results.resolve())
    vars(bare)["recordings"] = experiment.recordings  # searched once: the files of a folder may change
    return Job(bare, job.overwrite, retry=job.retry, command=job.command)


def bare_task(task: Task) -> Task:
    """Return the task with an absolute path."""
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
    """Return the outcome of a task that a worker completed just before it died; None of others."""
    outcome = standing(job, task) if task.path.exists() else None
    return replace(outcome, state="made") if outcome is not None and outcome.state == "kept" else None


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


class ProcessPool:
    """Engine of processes with one BLAS thread each. They start with the first tasks and run until `close`.

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
        """Run tasks; yield number and outcome of each, as in `gbid.experiment.run.TaskEngine`.

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
        waiting, deaths, stillborn = deque(range(len(tasks))), Counter[int](), 0
        try:
            for worker in self._workers:
                with contextlib.suppress(OSError):  # a dead worker is noticed when its pipe is read
                    worker.connection.send(shipped)
            while waiting or any(worker.number is not None for worker in self._workers):
                busy = sum(worker.number is not None for worker in self._workers)
                self._start(min(self.n_workers, len(waiting) + busy), shipped)
                for worker in self._workers:
                    if worker.ready and worker.number is None and waiting:
                        self._give(worker, waiting.popleft(), job, tasks)
                heard = wait([worker.connection for worker in self._workers])  # messages, and ends of processes
                for worker in [worker for worker in self._workers if worker.connection in heard]:
                    try:
                        message = worker.connection.recv()
                    except (EOFError, OSError):
                        number, how = worker.number, self._bury(worker)
                        if number is not None:
                            deaths[number] += 1
                            outcome = self._after_death(job, tasks[number], deaths[number], how)
                            if outcome is None:
                                waiting.append(number)
                            else:
                                yield number, outcome
                        elif not worker.ready:
                            stillborn += 1
                            if stillborn == ATTEMPTS:
                                raise GbidError(f"worker processes cannot start ({how}); try --engine serial") from None
                        continue
                    if message == READY:
                        worker.ready, stillborn = True, 0
                        continue
                    worker.number = None
                    number, result = message
                    if isinstance(result, str):
                        raise NoSpaceError(result)
                    if waiting:  # before the outcome is processed, so that the worker need not wait for that
                        self._give(worker, waiting.popleft(), job, tasks)
                    yield number, result
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
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(theirs,), daemon=True, name="gbid worker")
            with _environment(_OF_WORKERS), _without_interrupts():
                process.start()
            theirs.close()
            self._workers.append(_Worker(process, ours))
            with contextlib.suppress(OSError):
                ours.send(shipped)

    def _give(self, worker: _Worker, number: int, job: Job, tasks: Sequence[Task]) -> None:
        worker.number = number
        job.reporter.begin(tasks[number].stage, tasks[number].item)
        with contextlib.suppress(OSError):
            worker.connection.send((number, bare_task(tasks[number])))

    def _bury(self, worker: _Worker) -> str:
        """Remove a worker that died; return its signal or exit code as text."""
        self._workers.remove(worker)
        worker.connection.close()
        worker.process.join(_PATIENCE)
        code = worker.process.exitcode or 0
        return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def _after_death(self, job: Job, task: Task, times: int, how: str) -> Outcome | None:
        """Return the outcome of a task whose worker died; None when it will be tried again."""
        outcome = completed(job, task)
        if outcome is not None or times < ATTEMPTS:
            return outcome
        text = f"its process died {times} times ({how}); the usual reason for SIGKILL is too little memory"
        return fail(job, task, Failure(task.key, "crash", text))

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


def _has_one_thread() -> bool:
    """Return whether this process has no other thread, of Python or a library, that may hold a lock (on Linux)."""
    try:
        return len(list(Path("/proc/self/task").iterdir())) == 1
    except OSError:
        return False


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C for processes started in this context; the terminal sends it to all its processes."""
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


# ---- Dask engine: workers of a cluster, which must see the results folder under the same path.

_DASK_PATIENCE = 10.0  # longest time for a scheduler to answer [s]
_JOURNEYS, _LARGEST = 20, 16  # submissions per thread, for many tasks; largest number of tasks in one
_CALM = {  # Dask's own monitoring, which takes over a third of the time of short fits
    "distributed.worker.profile.enabled": False,  # a tenth of the time
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    # Dask's default contains MALLOC_TRIM_THRESHOLD_, with which each larger array is allocated anew by the system.
    "distributed.nanny.pre-spawn-environ": _OF_WORKERS,
}
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
        self._is_ours = scheduler is None or isinstance(scheduler, str)
        if not (scheduler is None or isinstance(scheduler, str)):
            if not isinstance(scheduler, Client):
                raise UsageError(
                    f"scheduler = {scheduler!r}; give its address, such as tcp://host:8786, or a Dask client"
                )
            if scheduler.status != "running" or scheduler.asynchronous:
                text = "is not connected" if scheduler.status != "running" else "is asynchronous"
                raise UsageError(f"the Dask client {text}; give a running Client(...) without asynchronous=True")
            self._cluster, self.client = None, scheduler
            return
        self._cluster = _local_cluster(n_workers) if scheduler is None else None
        try:
            self.client = Client(self._cluster or scheduler, timeout=_DASK_PATIENCE)
        except (OSError, ValueError) as error:
            text = f"no Dask scheduler answers at {scheduler}: {' '.join(str(error).split())}"
            raise UsageError(f"{text}; start it, or correct the address") from None

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; yield number and outcome of each, as in `gbid.experiment.run.TaskEngine`.

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

        shipped = pickle.dumps(bare_job(job))
        name = f"gbid-{hashlib.sha256(shipped).hexdigest()[:16]}"
        self._register(_carrier(shipped, alone=self._cluster is not None), name)
        threads = max(1, sum(self.client.nthreads().values()))
        sent, completed = {}, as_completed()

        upcoming, begun, ended = deque[int](), set[int](), set[int]()

        def begin(number: int) -> None:
            if number not in begun | ended:
                begun.add(number)
                job.reporter.begin(tasks[number].stage, tasks[number].item)

        def announce() -> None:
            """Report as many tasks as begun as there are threads; workers do not report which task they run."""
            while upcoming and len(begun) < threads:
                begin(upcoming.popleft())

        def settle(number: int) -> None:
            begin(number)
            begun.remove(number)
            ended.add(number)
            announce()

        def submit(chunk: list[int]) -> None:
            upcoming.extend(chunk)
            shipment = [bare_task(tasks[number]) for number in chunk]
            future = self.client.submit(_attempt_there, name, shipment, pure=False)
            sent[future] = chunk
            completed.add(future)

        try:
            for chunk in _chunks(len(tasks), threads):  # all at once: workers that join later take their share
                submit(chunk)
            announce()
            for future in completed:
                chunk, error = sent.pop(future), future.exception()
                if isinstance(error, KilledWorker) and len(chunk) > 1:
                    for number in chunk:  # one of them killed it; finished ones are kept
                        submit([number])
                elif error is None:
                    for number, result in zip(chunk, future.result(), strict=True):
                        settle(number)
                        yield number, self._checked(result, tasks[number])
                elif not isinstance(error, KilledWorker):
                    raise error
                else:
                    settle(chunk[0])
                    text = "the Dask workers that ran it died; the usual reason is too little memory"
                    yield chunk[0], fail(job, tasks[chunk[0]], Failure(tasks[chunk[0]].key, "crash", text))
        except (OSError, CancelledError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            text = f"the connection to the Dask scheduler is lost ({why})"
            raise UsageError(f"{text}; start it and run again; complete results stay") from None
        finally:
            with contextlib.suppress(OSError, CancelledError):  # when the scheduler or a worker has just ended
                if sent:
                    self.client.cancel(list(sent))
                self.client.unregister_worker_plugin(name)

    def _register(self, plugin: Any, name: str) -> None:
        """Register a plugin with all present and later workers; try again when a worker dies meanwhile."""
        for left in reversed(range(ATTEMPTS)):
            try:
                self.client.register_plugin(plugin, name=name)
                return
            except OSError as error:
                if not left:
                    raise GbidError(f"the Dask workers do not answer ({error}); check them, then run again") from None

    def close(self) -> None:
        """Disconnect from the scheduler, and stop the workers that this engine started; a given client stays open."""
        if self._is_ours:
            self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _checked(self, result: Outcome | str, task: Task) -> Outcome:
        if isinstance(result, str):
            raise NoSpaceError(result)
        if result.state == "made" and not task.path.exists():
            text = "a Dask worker made it, but it is missing here; workers must see the same results folder"
            raise DataError(f"{task.path}: {text}")
        return result


def _local_cluster(n_workers: int) -> Any:
    """Return a cluster of workers on this machine; try again when a worker dies at its start."""
    import dask
    from distributed import LocalCluster

    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    for trial in range(1, ATTEMPTS + 1):
        try:
            with dask.config.set(_CALM), _environment(_OF_WORKERS):
                return LocalCluster(n_workers=n_workers, **options)
        except RuntimeError as error:
            if trial == ATTEMPTS:
                text = f"Dask workers cannot start ({' '.join(str(error).split())}); try --engine pool"
                raise GbidError(text) from None
    raise AssertionError


def _carrier(shipped: bytes, alone: bool) -> Any:
    """Return a plugin that sends the job to each worker once; `alone`: the workers run nothing else."""
    from distributed import WorkerPlugin

    class JobCarrier(WorkerPlugin):  # type: ignore[misc]
        def __init__(self) -> None:
            self.shipped, self.alone = shipped, alone

        def setup(self, worker: Any) -> None:  # noqa: ARG002
            self.job = pickle.loads(self.shipped)
            if self.alone:
                collect_less()

    return JobCarrier()


def _chunks(count: int, threads: int) -> list[list[int]]:
    """Return the numbers of the tasks of each submission; many small submissions would take longer than the fits."""
    size = min(_LARGEST, max(1, count // (threads * _JOURNEYS)))
    return [list(range(first, min(first + size, count))) for first in range(0, count, size)]


def _attempt_there(name: str, tasks: list[Task]) -> list[Outcome | str]:
    from distributed import get_worker

    job = get_worker().plugins[name].job
    with _one_at_a_time:
        return [attempt(job, task) for task in tasks]


# ---- Engine by its name.

EngineName = Literal["auto", "serial", "pool", "dask"]

FEW = 8
"""Smallest number of tasks of a stage for which worker processes are started."""


def make_engine(name: str = "auto", workers: int | None = None, scheduler: str | Client | None = None) -> TaskEngine:
    """Return an engine that runs tasks.

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
        raise UsageError("the engine serial is this process alone; leave the number of workers out, or choose pool")
    affinity = getattr(os, "sched_getaffinity", None)  # missing on some systems
    count = workers or (len(affinity(0)) if affinity else os.cpu_count() or 1)
    if name == "dask" or scheduler is not None:
        return DaskEngine(scheduler, count)
    if name == "serial":
        return InTurn()

    return ProcessPool(count, 1 if name == "pool" else FEW)
