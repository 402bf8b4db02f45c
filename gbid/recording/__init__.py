"""Recordings: the data type, its HDF5 store, importers and quality checks."""

from gbid.core.arrays import FloatArray
from gbid.recording.importing import import_recording
from gbid.recording.mapping import ImportMapping, SignalMapping
from gbid.recording.quality import ProblemKind, SignalProblem, content_digest, find_group_problems, find_problems
from gbid.recording.recording import Recording, load_recording, save_recording, with_unbalance

__all__ = [
    "FloatArray",
    "ImportMapping",
    "ProblemKind",
    "Recording",
    "SignalMapping",
    "SignalProblem",
    "content_digest",
    "find_group_problems",
    "find_problems",
    "import_recording",
    "load_recording",
    "save_recording",
    "with_unbalance",
]
