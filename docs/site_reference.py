"""MkDocs hook: pages of the reference that are made from the code, so that they cannot say anything else."""

from __future__ import annotations

from typing import Any

from mkdocs.structure.files import File, Files

# What other programs use: by heading, names or (name, its members that are shown).
PYTHON: dict[str, tuple[str | tuple[str, str], ...]] = {
    "Stages": (
        "hypogoal.stages.collect.collect",
        "hypogoal.stages.train_ensemble.train_ensemble",
        "hypogoal.stages.train_options.train_options",
        "hypogoal.stages.train_meta.train_meta",
        "hypogoal.stages.train_baseline.train_baseline",
        "hypogoal.stages.evaluate.evaluate",
        "hypogoal.stages.report.report",
        "hypogoal.api.compare",
        ("hypogoal.look.Made", "metrics, show"),
    ),
    "Loading and playing": (
        "hypogoal.api.load_ensemble",
        "hypogoal.api.load_options",
        "hypogoal.options.env.Options",
        "hypogoal.options.env.OptionEnv",
        "hypogoal.options.reward.SubgoalReward",
        ("hypogoal.hypotheses.ensemble.Ensemble", "predict, attributions, see"),
        "hypogoal.core.errors.UserError",
    ),
    "Own domains": (
        "hypogoal.domains.gymnasium.domain.GymnasiumDomain",
        "hypogoal.domains.base.Domain",
        "hypogoal.domains.base.Engine",
        "hypogoal.domains.base.Step",
        "hypogoal.data.Collected",
        "hypogoal.data.States",
        "hypogoal.core.config.setting",
    ),
    "Contracts, as tests": (
        "hypogoal.check.check_domain",
        "hypogoal.check.check_objective",
        "hypogoal.check.check_network",
        "hypogoal.check.check_part",
        "hypogoal.check.check_view",
        "hypogoal.check.check_teacher",
        "hypogoal.check.require",
        "hypogoal.check.Verdict",
    ),
    "Data files": (
        "hypogoal.data.open_dataset",
        "hypogoal.data.Dataset",
        "hypogoal.data.write_dataset",
    ),
    "Objectives": (
        "hypogoal.diversity.dbat.pair_loss",
        ("hypogoal.diversity", "Context, load_objective"),
        ("hypogoal.hypotheses.fit", "fit, disagreement_of"),
        ("hypogoal.hypotheses.training", "EnsembleTraining, train"),
    ),
    "Numbers": (
        (
            "hypogoal.hypotheses.scores",
            "member_scores, ranking, best_threshold, cross_fitted, best_mean_worst, mean_disagreement",
        ),
        ("hypogoal.evaluation.table", "read_numbers, per_run"),
        ("hypogoal.evaluation.statistics", "over, pairs, compare, interval, bounded, median_bounds"),
        ("hypogoal.hypotheses.deep_lift", "attributed, Attributions"),
        "hypogoal.meta.smdp.smdp_advantages",
        "hypogoal.options.double_dqn.double_q_targets",
    ),
}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages; MkDocs calls it once it knows the pages that are files."""
    pages = {"cli": command_line(), "settings": settings(), "python": python()}
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def command_line() -> str:
    """What ``--help`` says of every command."""
    import click
    import typer
    from typer.cli import get_docs_for_click

    from hypogoal.cli import commands
    from hypogoal.command.program import app

    command: Any = typer.main.get_command(app)
    command.commands = commands()
    context = typer.Context(command) if not isinstance(command, click.Command) else click.Context(command)
    return get_docs_for_click(obj=command, ctx=context, name="hypogoal", title="Command line")


def settings() -> str:
    """What ``hypogoal config`` says of every stage: a table a stage, a column for each domain's default."""
    from hypogoal.core.presets import TABLES
    from hypogoal.domains.find import BUILT_IN

    lines = [
        "# Settings",
        "",
        "Every setting of every stage. `--set name=value` changes one, a preset changes several, and the manifest of "
        "what was made has them all. A domain's column has the default there, and a dash where the domain has no such "
        "setting. `hypogoal config STAGE --domain DOMAIN` prints the same.",
        "",
    ]
    for stage in TABLES:
        domains = " | ".join(BUILT_IN)
        rule = "---|" * (len(BUILT_IN) + 3)
        lines += [f"## {stage}", "", f"| setting | {domains} | meaning | source |", f"|{rule}"]
        lines += [_row(by_domain) for by_domain in settings_of(stage)]
        lines.append("")
    return "\n".join(lines)


def settings_of(stage: str) -> list[dict[str, Any]]:
    """The settings of a stage, each by the domains that have it. What means something else elsewhere is another one."""
    from hypogoal.core.presets import described
    from hypogoal.domains.find import BUILT_IN, layers_of
    from hypogoal.experiments.experiment import config_class_of

    found: dict[tuple[str, str], dict[str, Any]] = {}
    for domain in BUILT_IN:
        for row in described(config_class_of(stage, domain), *layers_of(stage, domain, None)):
            key = row["name"], row["meaning"] + row["allowed"]
            found.setdefault(key, {})[domain] = row
    return [*found.values()]


def python() -> str:
    """What the docstrings say of the names that other programs use."""
    lines = ["# Python", "", "What other programs use. Everything else may change between versions.", ""]
    for heading, names in PYTHON.items():
        lines += [f"## {heading}", ""]
        for entry in names:
            lines += _documented(entry)
    return "\n".join(lines)


def _documented(entry: str | tuple[str, str]) -> list[str]:
    if isinstance(entry, str):
        return [f"::: {entry}", ""]
    name, members = entry
    return [f"::: {name}", "    options:", f"      members: [{members}]", ""]


def _row(by_domain: dict[str, Any]) -> str:
    """A row of a table: a setting, its default on each domain, what it means and where the defaults come from."""
    from hypogoal.domains.find import BUILT_IN

    row = next(iter(by_domain.values()))
    allowed = f" ({row['allowed']})" if row["allowed"] else ""
    unit = f", in {row['unit']}" if row["unit"] else ""
    defaults = [_default(by_domain[domain]) if domain in by_domain else "-" for domain in BUILT_IN]
    sources = {domain: each["source"] for domain, each in by_domain.items()}
    source = row["source"]
    if len({*sources.values()}) > 1:
        source = "; ".join(f"{domain}: {text}" for domain, text in sources.items() if text)
    cells = [f"`{row['name']}`", *defaults, f"{row['meaning']}{unit}{allowed}", source]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(row: dict[str, Any]) -> str:
    """A default as one types it."""
    value = row["default"]
    text = ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
    return text or "(none)"
