"""`gbid doctor`: whether this machine has what gbid needs, and what it does without."""

from __future__ import annotations

from gbid.cli.guard import guarded
from gbid.cli.options import AsJson, Debug


def doctor(as_json: AsJson = False, debug: Debug = False) -> None:
    """Show compiler, cache, versions, disk and threads of this machine, and what to do where something is missing."""
    with guarded(as_json, debug):
        import typer

        from gbid.campaign.examination import Verdict, examine
        from gbid.cli.printing import print_json, print_tables
        from gbid.cli.telling import tell
        from gbid.tables.table import Column, Table

        found = examine()
        if as_json:
            print_json({"findings": [finding.document() for finding in found]})
        else:
            columns = [Column("what"), Column("verdict"), Column("found", wrap=True)]
            rows = [[finding.what, finding.verdict.value, finding.found] for finding in found]
            print_tables(Table("this machine", columns, rows))
        for finding in found:
            if finding.remedy:
                tell(f"gbid: {finding.verdict.value}: {finding.what}: {finding.remedy}")
        if any(finding.verdict is Verdict.BAD for finding in found):
            raise typer.Exit(1)
