"""Overview of `gbid --help`: verbs in groups, and examples to copy."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

START, DATA, IDENTIFY, CONTROL, REPORT = "Start", "Data", "Identify", "Control", "Report"
GROUPS = (START, DATA, IDENTIFY, CONTROL, REPORT)
"""Groups in the order of the work; a verb names its group as `rich_help_panel`."""


class GroupedCommands(TyperGroup):
    """Command group that lists the verbs by group, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the groups in their order; verbs without group come last."""
        rows: dict[str, list[tuple[str, str]]] = {group: [] for group in GROUPS}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                group = getattr(command, "rich_help_panel", None)
                group = group if isinstance(group, str) else "Other"
                rows.setdefault(group, []).append((name, command.get_short_help_str(200)))
        width = max(len(name) for group in rows.values() for name, _ in group)
        for group, lines in rows.items():
            if lines:
                with formatter.section(group):
                    formatter.write_dl([(f"{name:{width}}", text) for name, text in lines])


def examples(*lines: str) -> str:
    """Return an epilog with command lines, one per line."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])
