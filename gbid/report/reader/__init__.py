"""The one reader of results: what the stages of an experiment stored, for pages, figures, tables and verbs."""

from gbid.report.reader.results import Results

__all__ = ["Results"]
