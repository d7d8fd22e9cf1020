"""MkDocs hook: pages of the reference that are made from the code, so that they cannot say anything else."""

from __future__ import annotations

from typing import Any

from mkdocs.structure.files import File, Files


def on_files(files: Files, config: Any) -> Files:
    """Add the pages; MkDocs calls it once it knows the pages that are files."""
    for name, text in (("reference/cli.md", command_line()), ("reference/settings.md", settings())):
        files.append(File.generated(config, name, content=text))
    return files


def command_line() -> str:
    """What ``--help`` says of every command."""
    import click
    import typer
    from typer.cli import get_docs_for_click

    from hypogoal.cli import app, commands

    command: Any = typer.main.get_command(app)
    command.commands = commands()
    context = typer.Context(command) if not isinstance(command, click.Command) else click.Context(command)
    return get_docs_for_click(obj=command, ctx=context, name="hypogoal", title="Command line")


def settings() -> str:
    """What ``hypogoal config`` says of every stage, on each domain that comes with hypogoal."""
    from hypogoal.core.config import TABLES, described
    from hypogoal.domains.base import BUILT_IN, layers_of
    from hypogoal.experiments.named import config_class_of

    lines = [
        "# Settings",
        "",
        "Every setting of every stage: `--set name=value` changes one, a preset changes several, and the manifest of "
        "what was made has them all. `hypogoal config STAGE --domain DOMAIN` prints the same.",
        "",
    ]
    for domain in BUILT_IN:
        for stage in TABLES:
            rows = described(config_class_of(stage, domain), *layers_of(stage, domain))
            lines += [f"## {stage}, {domain}", "", "| setting | default | meaning | source |", "|---|---|---|---|"]
            lines += [_row(row) for row in rows]
            lines.append("")
    return "\n".join(lines)


def _row(row: dict[str, Any]) -> str:
    default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple | list) else str(row["default"])
    allowed = f" ({row['allowed']})" if row["allowed"] else ""
    cells = (
        f"`{row['name']}`",
        f"{default or '(none)'} {row['unit']}".strip(),
        row["meaning"] + allowed,
        row["source"],
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
