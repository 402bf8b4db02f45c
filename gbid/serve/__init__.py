"""Local web pages: one turns a folder of recordings into an experiment, one shows results while a campaign runs."""

from gbid.serve.bench import open_bench
from gbid.serve.server import Server, open_server

__all__ = ["Server", "open_bench", "open_server"]
