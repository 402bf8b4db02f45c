"""Pool of worker processes on this machine; the death of a worker does not stop the others."""

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
from multiprocessing import connection as pipes
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from ruamel.yaml.comments import CommentedMap

from gbid.core.errors import GbidError, NoSpaceError
from gbid.core.yaml_file import YamlFile
from gbid.experiment.run import Failure, Job, Outcome, Task, fail, perform, standing

# ---- Worker process: it runs the tasks that it receives through a pipe.

READY = "ready"


def serve(connection: Connection) -> None:
    """Run tasks until the pipe is closed.

    A message is a job (pickled), which is used for the following tasks, or a task with its number. The worker answers a
    task with its number and the result of `gbid.experiment.pool.attempt`. It ignores Ctrl-C, because the runner stops
    its workers. When the runner is gone, it ends at once, also in the middle of a task: results appear only when they
    are complete.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
    there = replace(experiment, file=file, results=experiment.results.resolve())
    vars(there)["recordings"] = experiment.recordings  # searched once: the files of a folder may change
    return Job(there, job.overwrite, retry=job.retry)


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
    if task.path.exists():
        there = standing(job, task)
        if there is not None and there.state == "kept":
            return replace(there, state="made")
    try:
        return perform(job, task)
    except NoSpaceError as error:
        return str(error)


ATTEMPTS = 3
"""Number of times that a task may kill its worker before it counts as failed."""

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_PATIENCE = 3.0  # longest time for a worker to end [s]


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    connection: Connection
    ready: bool = False
    number: int | None = None  # of the task that it runs


class ProcessPool:
    """Engine of spawned processes with one BLAS thread each. They start with the first tasks and run until `close`.

    A task whose worker dies is given to another worker, up to `ATTEMPTS` times in all. Then it has failed.

    Parameters
    ----------
    n_workers : int
        Largest number of processes.
    """

    def __init__(self, n_workers: int) -> None:
        self.n_workers = n_workers
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
                for worker in self._ready():
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
        context = get_context("spawn")
        for _ in range(count - len(self._workers)):
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(theirs,), daemon=True, name="gbid worker")
            with _environment(dict.fromkeys(ONE_THREAD, "1")), _without_interrupts():
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

    def _ready(self) -> list[_Worker]:
        """Return the workers with a message, or whose process has ended; wait for the first."""
        heard = pipes.wait([worker.connection for worker in self._workers])
        return [worker for worker in self._workers if worker.connection in heard]

    def _bury(self, worker: _Worker) -> str:
        """Remove a worker that died; return its signal or exit code as text."""
        self._workers.remove(worker)
        worker.connection.close()
        worker.process.join(_PATIENCE)
        code = worker.process.exitcode
        if code is not None and code < 0:
            return f"signal {signal.Signals(-code).name}"
        return f"exit code {code}"

    def _after_death(self, job: Job, task: Task, times: int, how: str) -> Outcome | None:
        """Return the outcome of a task whose worker died; None when it will be tried again."""
        there = standing(job, task)
        if there is not None and there.state == "kept":
            return replace(there, state="made")  # completed just before the worker died
        if times < ATTEMPTS:
            return None
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
