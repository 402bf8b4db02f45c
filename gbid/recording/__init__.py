"""Recordings: the data object, its HDF5 store, and importers of other formats."""

from gbid.recording.recording import FloatArray, Recording

__all__ = ["FloatArray", "Recording"]
