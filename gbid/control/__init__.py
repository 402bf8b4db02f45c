"""Closed loop, damping and controllers."""

from gbid.control.controllers import p_controller
from gbid.control.loop import close_loop

__all__ = ["close_loop", "p_controller"]
