"""The process of a worker: it runs tasks that come through a pipe."""

from __future__ import annotations

import pickle
import signal
from multiprocessing.connection import Connection

READY = "ready"


def serve(connection: Connection) -> None:
    """Run tasks until the pipe is closed.

    A message is a job (pickled), which holds for the tasks that follow, or the number of a task and the task. The
    answer to a task is its number and what `gbid.campaign.shipping.attempt` gives. Ctrl-C is left to the runner,
    which ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from gbid.campaign.shipping import attempt  # imports everything: once, before the first task

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
    except (EOFError, OSError):  # the runner is gone
        return
