"""Import of recordings from csv, npz and mat files by a mapping."""

from gbid.recording.importers.importing import import_recording
from gbid.recording.importers.mapping import ImportMapping, SignalMapping

__all__ = ["ImportMapping", "SignalMapping", "import_recording"]
