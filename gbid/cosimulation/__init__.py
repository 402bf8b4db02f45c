"""Co-simulation units (FMU, FMI 2.0) of the plant over pressure and speed, and of the whole loop."""

from gbid.cosimulation.save_fmu import save_fmu

__all__ = ["save_fmu"]
