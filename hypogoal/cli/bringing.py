"""The commands for what users bring: ``check``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from hypogoal.cli.common import Seed, Set, app

if TYPE_CHECKING:
    from hypogoal.testing import Verdict


@app.command()
def check(
    domain: Annotated[str | None, typer.Argument(help="A domain: a name or module:object.")] = None,
    diversity: Annotated[str | None, typer.Option(help="A diversity objective: a name or module:function.")] = None,
    network: Annotated[str | None, typer.Option(help="A member network: a name or module:function.")] = None,
    set_: Set = None,
    seed: Seed = 0,
    layout_seed: Annotated[int, typer.Option(min=0, help="The layout that is played.")] = 0,
) -> None:
    """Check that an own domain, diversity objective or network keeps to its contract; exit code 2 when not.

    --set changes how states of the domain are collected, as for 'collect'; they are collected twice.
    """
    from hypogoal.core import own_code
    from hypogoal.core.errors import UserError

    if domain is None and diversity is None and network is None:
        raise UserError("nothing to check", None, "Give a domain, --diversity or --network.")
    kept = True
    with own_code.given(*(name for name in (domain, diversity, network) if name)):
        for verdict in _verdicts(domain, diversity, network, set_ or [], seed, layout_seed):
            for line in verdict.lines:
                typer.echo(line)
            kept &= verdict.ok
    if not kept:
        raise typer.Exit(2)


def _verdicts(
    domain: str | None, diversity: str | None, network: str | None, assignments: list[str], seed: int, layout_seed: int
) -> Iterator[Verdict]:
    from hypogoal.core.config import resolve
    from hypogoal.testing import check_domain, check_network, check_objective

    shape: tuple[int, ...] = (64, 64, 3)
    if domain is not None:
        from hypogoal.domains.base import load_domain

        found = load_domain(domain, given=True)
        config: object = resolve(found.config_class, stage="collect", assignments=assignments)
        yield from check_domain(found, config, layout_seed=layout_seed, seed=seed)
        shape = tuple(found.observation_shape)
    if diversity is not None:
        from hypogoal.diversity import load_objective

        yield from check_objective(load_objective(diversity))
    if network is not None:
        yield from check_network(network, shape)
