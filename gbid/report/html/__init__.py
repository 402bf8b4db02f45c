"""The report of an experiment: one HTML file with everything in it, read from the results that are there."""

from gbid.report.html.report_file import write_report

__all__ = ["write_report"]
