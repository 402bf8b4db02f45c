"""Reader of results: it loads the stored results of an experiment for pages, figures, tables and verbs."""

from gbid.report.reader.results import Results

__all__ = ["Results"]
