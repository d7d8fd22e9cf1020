"""Benchmarks of hypothesis learning: which features an objective finds when the answer is known (Spec H1)."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from hypogoal.cli import common as cli
from hypogoal.core.terminal import draw, give

ENTRIES = (
    "Comma-separated: dbat, none, another objective (docs/concepts.md) or module:function, each also with a weight "
    "(dbat:0.01); cnn, one member; oracle, one taught by each feature's truth; joint, by proposals."
)
benchmark = typer.Typer(cls=cli.Commands, no_args_is_help=True)
cli.app.add_typer(benchmark, name="benchmark", rich_help_panel=cli.MANY)


@benchmark.callback()
def _group() -> None:
    """Score diversity objectives when the answer is known."""


@cli.command(cli.MANY, "benchmark which-feature --out runs/which", "which-feature", benchmark)
def which_feature(
    out: Annotated[Path, Option("--out", help="A folder. Give it again to continue.")],
    diversity: Annotated[str, Option(help=ENTRIES)] = "dbat,none,oracle",
    mix: Annotated[str, Option(help="Shares of unlabelled states with independent features: 0.1,0.5.")] = "0.5",
    members: Annotated[int, Option(help="Hypotheses (K) of an entry.")] = 4,
    seeds: Annotated[str, Option(help="0-4, or 0,3,7.")] = "0-4",
    scenes: Annotated[str, Option(help="tiles, or textures: objects of any size at any pixel.")] = "tiles",
    factors: Annotated[
        str, Option(help="Planted features; another one is moved, with two frames.")
    ] = "colour,shape,place,count",
    high: Annotated[float, Option(help="A member owns a feature that it ranks at least this well,")] = 0.95,
    low: Annotated[float, Option(help="if it ranks every other at most this well, either way round.")] = 0.6,
    set_: cli.Set = None,
    quiet: cli.Quiet = False,
) -> None:
    """Which of several features that fit do members find?

    Small scenes have planted features (--factors): colour, shape and place of
    an object, and the number of boxes. In labelled scenes all of them agree; in
    a share of the unlabelled ones (--mix) each is drawn independently. Members
    are trained as by train-ensemble (--set takes its settings) and scored on
    scenes in which all features are crossed:

    - coverage: the share of features that some member ranks by (area under the
    ROC curve of at least --high) while it ranks by no other, neither way round
    (1 - --low to --low)
    - best: the highest ranking of a feature by a member, mean over features
    - same: the share of pairs of members that rank most by the same feature
    - gap: what the threshold of 0.5 costs in balanced accuracy
    - labels: how many it takes to find the right member, for covered features

    Writes results.csv: a line for each entry, mix, seed, member and feature.
    """
    from hypogoal.core import own_code
    from hypogoal.core.compute import prepare
    from hypogoal.which_feature import run, table

    prepare()
    options = {"diversity": diversity, "mix": mix, "members": members, "seeds": seeds, "scenes": scenes}
    config = run.resolved({**options, "factors": factors, "high": high, "low": low}, set_ or ())
    with own_code.given(*run.objectives_in(diversity), *cli.values_of(set_)):
        cells = run.run(config, out, quiet)
    draw(table.table_of(cells, config), 79)
    give(out / "results.csv")
