"""Results as pages on this machine, which follow a running campaign, and a gain explorer for every controller."""

from gbid.serve.server import Server, open_server

__all__ = ["Server", "open_server"]
