"""Spec B6: episodes of a trained agent as a Minari dataset, for offline learning with other software."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from hypogoal.core.artefacts import claim, open_artefact
from hypogoal.core.compute import prepare
from hypogoal.core.drafts import draft, put_in_place
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.meta.episodes import Episode, agent_of, play_episodes
from hypogoal.own_data.minari import write_minari

NAME = re.compile(r"[A-Za-z0-9_-]+-v\d+")


def export_episodes(
    meta: Path, out: Path, *, episodes: int = 20, seed: int = 0, force: bool = False, quiet: bool = False
) -> int:
    """Let the agent of a meta artefact play and write its episodes as a Minari dataset; returns the number of steps.

    ``out`` is the dataset's folder; its name, such as ``solved-v0``, ends the dataset's id, see :func:`dataset_id`.
    ``seed`` determines the draws of options. ``force`` replaces an empty folder only. A missing agent, another name, or
    an existing ``out`` is a ``UserError``.
    """
    prepare()
    if not NAME.fullmatch(out.name):
        raise UserError("a Minari dataset needs a version in its name", out.name, "Give --out DIR/NAME-v0.")
    source = open_artefact(meta, "meta").whole()
    out = claim(out, kind="episodes", inputs=[meta], force=force)
    where = source.config["layouts"] or source.config["layout_seed"]
    described = (
        f"Episodes of an agent that chooses among {len(source.config['sub_goals']) * source.config['members']} options "
        f"({source.config['domain']}, layout seed {where}, seed {seed})."
    )
    loop = agent_of(source, seed)

    def counted(progress: Progress) -> Iterator[Episode]:
        for number, episode in enumerate(play_episodes(loop, episodes), 1):
            yield episode
            progress.update(number)

    with draft(out, {"kind": "episodes"}, force=force) as work:
        with Progress("export", total=episodes, quiet=quiet) as progress:
            details = {"name": dataset_id(out), "description": described}
            steps = write_minari(work.files, counted(progress), actions=loop.engine.n_actions, **details)
        put_in_place(work.files, out)
    return steps


def dataset_id(out: Path) -> str:
    """The id by which minari finds a dataset's folder: its path below minari's root folder, else its name."""
    configured = os.environ.get("MINARI_DATASETS_PATH")
    root = Path(os.path.expanduser("~"), ".minari", "datasets") if configured is None else Path(configured)
    place, root = out.resolve(), root.resolve()
    return place.relative_to(root).as_posix() if place.is_relative_to(root) else out.name
