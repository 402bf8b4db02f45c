"""Dask engine: workers of a cluster, which must see the results folder under the same path."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import threading
from collections import deque
from collections.abc import Generator, Sequence
from typing import Any

from gbid.core.errors import DataError, GbidError, NoSpaceError, UsageError
from gbid.experiment.pool import ATTEMPTS, ONE_THREAD, attempt, bare_job, bare_task
from gbid.experiment.run import Failure, Job, Outcome, Task, fail

_PATIENCE = 10.0  # longest time for a scheduler to answer [s]
_AHEAD = 3  # submissions per thread of a worker at a time, so that it need not wait
_JOURNEYS, _LARGEST = 50, 16  # submissions per thread in all, for many tasks; largest number of tasks in one
_CALM = {  # Dask's own monitoring, which takes over a third of the time of short fits
    "distributed.worker.profile.enabled": False,  # a tenth of the time
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    # Dask's default contains MALLOC_TRIM_THRESHOLD_, with which each larger array is allocated anew by the system.
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(ONE_THREAD, 1),
}
_one_at_a_time = threading.Lock()  # in each worker process: the solver is not thread-safe


class DaskEngine:
    """Engine that runs tasks on a Dask scheduler, or on a Dask cluster of processes on this machine.

    Parameters
    ----------
    scheduler : str, optional
        Address of the scheduler, ``tcp://host:port``; without it, workers are started on this machine.
    n_workers : int
        Number of workers to start on this machine.

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    GbidError
        When no workers can be started on this machine.
    """

    def __init__(self, scheduler: str | None, n_workers: int) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise UsageError("Dask is not installed; install it with: pip install 'gbid[dask]'") from None
        self._cluster = _local_cluster(n_workers) if scheduler is None else None
        try:
            self.client: Any = Client(self._cluster or scheduler, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            text = " ".join(str(error).split())
            raise UsageError(
                f"no Dask scheduler answers at {scheduler}: {text}; start it, or correct the address"
            ) from None

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
        self._register(_carrier(shipped), name)
        threads = max(1, sum(self.client.nthreads().values()))
        waiting, sent, completed = _chunks(len(tasks), threads), {}, as_completed()

        upcoming, begun, ended = deque[int](), set[int](), set[int]()

        def begin(number: int) -> None:
            if number not in begun and number not in ended:
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

        def submit() -> None:
            if waiting:
                chunk = waiting.popleft()
                upcoming.extend(chunk)
                there = [bare_task(tasks[number]) for number in chunk]
                future = self.client.submit(_attempt_there, name, there, pure=False)
                sent[future] = chunk
                completed.add(future)

        try:
            for _ in range(_AHEAD * threads):
                submit()
            announce()
            for future in completed:
                chunk, error = sent.pop(future), future.exception()
                if isinstance(error, KilledWorker) and len(chunk) > 1:
                    waiting.extendleft([number] for number in chunk)  # one of them killed it; finished ones are kept
                submit()
                if error is None:
                    for number, result in zip(chunk, future.result(), strict=True):
                        settle(number)
                        yield number, self._checked(result, tasks[number])
                elif not isinstance(error, KilledWorker):
                    raise error
                elif len(chunk) == 1:
                    settle(chunk[0])
                    text = "the Dask workers that ran it died; the usual reason is too little memory"
                    yield chunk[0], fail(job, tasks[chunk[0]], Failure(tasks[chunk[0]].key, "crash", text))
        except (OSError, CancelledError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            raise UsageError(
                f"the connection to the Dask scheduler is lost ({why}); start it and run again; complete results stay"
            ) from None
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
        """Disconnect from the scheduler, and stop the workers that this engine started."""
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _checked(self, result: Outcome | str, task: Task) -> Outcome:
        if isinstance(result, str):
            raise NoSpaceError(result)
        if result.state == "made" and not task.path.exists():
            raise DataError(
                f"{task.path}: a Dask worker made it, but it is missing here; workers must see the same results folder"
            )
        return result


def _local_cluster(n_workers: int) -> Any:
    """Return a cluster of workers on this machine; try again when a worker dies at its start."""
    import dask
    from distributed import LocalCluster

    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": ":0", "host": "127.0.0.1"}
    for trial in range(1, ATTEMPTS + 1):
        try:
            with dask.config.set(_CALM):
                return LocalCluster(n_workers=n_workers, **options)
        except RuntimeError as error:
            if trial == ATTEMPTS:
                text = f"Dask workers cannot start ({' '.join(str(error).split())}); try --engine pool"
                raise GbidError(text) from None
    raise AssertionError


def _carrier(shipped: bytes) -> Any:
    """Return a plugin that sends the job to each worker once."""
    from distributed import WorkerPlugin

    class JobCarrier(WorkerPlugin):  # type: ignore[misc]
        def __init__(self) -> None:
            self.shipped = shipped

        def setup(self, worker: Any) -> None:  # noqa: ARG002
            self.job = pickle.loads(self.shipped)

    return JobCarrier()


def _chunks(count: int, threads: int) -> deque[list[int]]:
    """Return the numbers of the tasks of each submission; many small submissions would take longer than the fits."""
    size = min(_LARGEST, max(1, count // (threads * _JOURNEYS)))
    return deque(list(range(first, min(first + size, count))) for first in range(0, count, size))


def _attempt_there(name: str, tasks: list[Task]) -> list[Outcome | str]:
    from distributed import get_worker

    job = get_worker().plugins[name].job
    with _one_at_a_time:
        return [attempt(job, task) for task in tasks]
