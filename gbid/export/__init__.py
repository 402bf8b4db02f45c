"""What other programs read: tables, MATLAB, ROSS, C, FMU. Names are imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_NAMES = {
    "chain": (
        "Chain",
        "ChainOptions",
        "chain_of",
    ),
    "chain_c": (
        "CompiledChain",
        "write_chain",
    ),
    "chain_python": (
        "ChainFault",
        "ChainInput",
        "ChainMode",
        "ChainOutput",
        "PythonChain",
    ),
    "fmu": ("save_fmu",),
    "matlab": (
        "Exportable",
        "save_mat",
    ),
    "ross": (
        "bearing_element",
        "from_ross",
    ),
    "tables": (
        "save_csv",
        "save_yaml",
    ),
}
"""Public names of each module."""
__all__ = [
    "Chain",
    "ChainFault",
    "ChainInput",
    "ChainMode",
    "ChainOptions",
    "ChainOutput",
    "CompiledChain",
    "Exportable",
    "PythonChain",
    "bearing_element",
    "chain_of",
    "from_ross",
    "save_csv",
    "save_fmu",
    "save_mat",
    "save_yaml",
    "write_chain",
]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(import_module(f"gbid.export.{module}"), name)
    raise AttributeError(f"module 'gbid.export' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
