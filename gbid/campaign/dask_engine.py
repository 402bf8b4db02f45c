"""Workers of a Dask cluster. They must see the results folder under the same path."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import deque
from collections.abc import Generator, Sequence
from typing import Any

from gbid.campaign.shipping import attempt, bare_job, bare_task
from gbid.errors import DataError, NoSpaceError, UsageError
from gbid.experiment.stages import Job, Outcome, Task, fail
from gbid.experiment.stages.failures import Failure

_PATIENCE = 10.0  # seconds for a scheduler to answer
_AHEAD = 3  # journeys for each thread of a worker at a time, so that it need not wait
_JOURNEYS, _LARGEST = 50, 16  # for each thread in all, when there are many tasks; tasks of one journey
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
    """

    def __init__(self, scheduler: str | None, n_workers: int) -> None:
        try:
            import dask
            from distributed import Client, LocalCluster
        except ImportError:
            raise UsageError("Dask is not installed; install it with: pip install 'gbid[dask]'") from None
        self._cluster = None
        if scheduler is None:
            with dask.config.set({"distributed.worker.profile.enabled": False}):  # it takes a tenth of the time
                self._cluster = LocalCluster(
                    n_workers=n_workers, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
                )
        try:
            self.client: Any = Client(self._cluster or scheduler, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            text = " ".join(str(error).split())
            raise UsageError(
                f"no Dask scheduler answers at {scheduler}: {text}; start it, or correct the address"
            ) from None

    def outcomes(self, job: Job, tasks: Sequence[Task]) -> Generator[tuple[int, Outcome], None, None]:
        """Run tasks; see `gbid.experiment.stages.Engine`.

        Raises
        ------
        NoSpaceError
            When the disk is full.
        DataError
            When the workers write to another results folder than this process sees.
        """
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        shipped = pickle.dumps(bare_job(job))
        name = f"gbid-{hashlib.sha256(shipped).hexdigest()[:16]}"
        self.client.register_plugin(_carrier(shipped), name=name)  # workers that come later get it as well
        threads = max(1, sum(self.client.nthreads().values()))
        waiting, sent, completed = _chunks(len(tasks), threads), {}, as_completed()

        def submit() -> None:
            if waiting:
                chunk = waiting.popleft()
                for number in chunk:
                    job.reporter.begin(tasks[number].stage, tasks[number].item)
                there = [bare_task(tasks[number]) for number in chunk]
                future = self.client.submit(_attempt_there, name, there, pure=False)
                sent[future] = chunk
                completed.add(future)

        try:
            for _ in range(_AHEAD * threads):
                submit()
            for future in completed:
                chunk, error = sent.pop(future), future.exception()
                if isinstance(error, KilledWorker) and len(chunk) > 1:
                    waiting.extendleft([number] for number in chunk)  # one of them was it; those that are done stay so
                submit()
                if error is None:
                    for number, result in zip(chunk, future.result(), strict=True):
                        yield number, self._checked(result, tasks[number])
                elif not isinstance(error, KilledWorker):
                    raise error
                elif len(chunk) == 1:
                    text = "the Dask workers that ran it died; mostly this means that memory was short"
                    yield chunk[0], fail(job, tasks[chunk[0]], Failure(tasks[chunk[0]].key, "crash", text))
        finally:
            if sent:
                self.client.cancel(list(sent))
            self.client.unregister_worker_plugin(name)

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
