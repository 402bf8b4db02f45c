"""Worker process: it runs the tasks that it receives through a pipe."""

from __future__ import annotations

import pickle
import signal
from multiprocessing.connection import Connection

READY = "ready"


def serve(connection: Connection) -> None:
    """Run tasks until the pipe is closed.

    A message is a job (pickled), which is used for the following tasks, or a task with its number. The worker answers a
    task with its number and the result of `gbid.campaign.shipping.attempt`. It ignores Ctrl-C, because the runner stops
    its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from gbid.campaign.shipping import attempt  # imports all packages, once, before the first task

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
