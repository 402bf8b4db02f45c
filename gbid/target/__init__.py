"""Control chain for a real-time target: from tuned design to C source, with its reference in Python."""

from gbid.target.chain import Chain
from gbid.target.chain_options import ChainOptions
from gbid.target.compiled_chain import CompiledChain
from gbid.target.design_chain import chain_of
from gbid.target.python_chain import ChainFault, ChainInput, ChainMode, ChainOutput, PythonChain
from gbid.target.write_chain import write_chain

__all__ = [
    "Chain",
    "ChainFault",
    "ChainInput",
    "ChainMode",
    "ChainOptions",
    "ChainOutput",
    "CompiledChain",
    "PythonChain",
    "chain_of",
    "write_chain",
]
