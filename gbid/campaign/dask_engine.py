"""Workers of a Dask cluster. They must see the results folder under the same path."""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import threading
from collections import deque
from collections.abc import Generator, Sequence
from typing import Any

from gbid.campaign.pool import ATTEMPTS, ONE_THREAD
from gbid.campaign.shipping import attempt, bare_job, bare_task
from gbid.errors import DataError, GbidError, NoSpaceError, UsageError
from gbid.experiment.run.failures import Failure
from gbid.experiment.run.job import Job, Task
from gbid.experiment.run.outcome import Outcome
from gbid.experiment.run.perform import fail

_PATIENCE = 10.0  # seconds for a scheduler to answer
_AHEAD = 3  # journeys for each thread of a worker at a time, so that it need not wait
_JOURNEYS, _LARGEST = 50, 16  # for each thread in all, when there are many tasks; tasks of one journey
_CALM = {  # what Dask does beside the tasks, many times for each fit: over a third of a short one, in sum
    "distributed.worker.profile.enabled": False,  # a tenth of the time
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    # Dask's own has MALLOC_TRIM_THRESHOLD_ as well: every larger array goes back to the system and is taken anew.
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(ONE_THREAD, 1),
}
_one_at_a_time = threading.Lock()  # in each worker process: the solver bears no threads


class DaskEngine:
    """A Dask scheduler that is running somewhere, or a cluster of processes on this machine.

    Parameters
    ----------
    scheduler : str, optional
        Its address, ``tcp://host:port``; without, workers are started here.
    n_workers : int
        How many are started here.

    Raises
    ------
    UsageError
        When Dask is not installed, or no scheduler answers.
    GbidError
        When no workers can be started here.
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
        """Run tasks; see `gbid.experiment.run.job.TaskEngine`.

        Raises
        ------
        NoSpaceError
            When the disk is full.
        DataError
            When the workers write to another results folder than this process sees.
        UsageError
            When the scheduler is lost.
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
            """Tell of as many tasks as there are threads; a worker does not say which one it is at."""
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
                    waiting.extendleft([number] for number in chunk)  # one of them was it; those that are done stay so
                submit()
                if error is None:
                    for number, result in zip(chunk, future.result(), strict=True):
                        settle(number)
                        yield number, self._checked(result, tasks[number])
                elif not isinstance(error, KilledWorker):
                    raise error
                elif len(chunk) == 1:
                    settle(chunk[0])
                    text = "the Dask workers that ran it died; mostly this means that memory was short"
                    yield chunk[0], fail(job, tasks[chunk[0]], Failure(tasks[chunk[0]].key, "crash", text))
        except (OSError, CancelledError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            raise UsageError(
                f"the Dask scheduler was lost ({why}); start it and run again, what is complete is kept"
            ) from None
        finally:
            with contextlib.suppress(OSError, CancelledError):  # when it is gone, or a worker dies at this moment
                if sent:
                    self.client.cancel(list(sent))
                self.client.unregister_worker_plugin(name)

    def _register(self, plugin: Any, name: str) -> None:
        """Give a plugin to all workers; again when one dies at this moment. Those that come later get it as well."""
        for left in reversed(range(ATTEMPTS)):
            try:
                self.client.register_plugin(plugin, name=name)
                return
            except OSError as error:
                if not left:
                    raise GbidError(
                        f"the Dask workers do not answer ({error}); look after them, then run again"
                    ) from None

    def close(self) -> None:
        """Leave the scheduler, and end the workers that were started here."""
        self.client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _checked(self, result: Outcome | str, task: Task) -> Outcome:
        if isinstance(result, str):
            raise NoSpaceError(result)
        if result.state == "made" and not task.path.exists():
            raise DataError(
                f"{task.path}: a Dask worker made it, but it is not here; workers must see the same results folder"
            )
        return result


def _local_cluster(n_workers: int) -> Any:
    """Start workers on this machine; again when one of them dies before it has begun."""
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
    """Return a plugin that brings the job to each worker once."""
    from distributed import WorkerPlugin

    class JobCarrier(WorkerPlugin):  # type: ignore[misc]
        def __init__(self) -> None:
            self.shipped = shipped

        def setup(self, worker: Any) -> None:  # noqa: ARG002
            self.job = pickle.loads(self.shipped)

    return JobCarrier()


def _chunks(count: int, threads: int) -> deque[list[int]]:
    """Numbers of the tasks that travel together: many small journeys would cost more than the fits gain."""
    size = min(_LARGEST, max(1, count // (threads * _JOURNEYS)))
    return deque(list(range(first, min(first + size, count))) for first in range(0, count, size))


def _attempt_there(name: str, tasks: list[Task]) -> list[Outcome | str]:
    from distributed import get_worker

    job = get_worker().plugins[name].job
    with _one_at_a_time:
        return [attempt(job, task) for task in tasks]
