"""What other programs read: tables, MATLAB, ROSS, C, FMU."""

from gbid.export.chain import Chain, ChainOptions, chain_of
from gbid.export.chain_c import CompiledChain, write_chain
from gbid.export.chain_python import ChainFault, ChainInput, ChainMode, ChainOutput, PythonChain
from gbid.export.fmu import save_fmu
from gbid.export.matlab import Exportable, save_mat
from gbid.export.ross import bearing_element, from_ross
from gbid.export.tables import save_csv, save_yaml

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
