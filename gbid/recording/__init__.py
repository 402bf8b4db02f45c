"""Recordings: the data type, its HDF5 store, importers and quality checks."""

from gbid.arrays import FloatArray
from gbid.recording.importers import ImportMapping, SignalMapping, import_recording
from gbid.recording.quality import find_problems
from gbid.recording.quality_group import content_digest, find_group_problems
from gbid.recording.quality_problem import ProblemKind, SignalProblem
from gbid.recording.recording import Recording
from gbid.recording.recording_store import load_recording, save_recording
from gbid.recording.unbalance_signal import with_unbalance

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
