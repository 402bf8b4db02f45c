"""Report of an experiment: one self-contained HTML file, made from the stored results."""

from gbid.report.html.report_file import write_report

__all__ = ["write_report"]
