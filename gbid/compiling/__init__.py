"""Compilation of C sources, once per machine, with a cache of the libraries."""

from gbid.compiling.cache_folder import cache_folder
from gbid.compiling.compiler import CompilerMissingError, compile_shared
from gbid.compiling.library import FLAGS, Library, load_library

__all__ = ["FLAGS", "CompilerMissingError", "Library", "cache_folder", "compile_shared", "load_library"]
