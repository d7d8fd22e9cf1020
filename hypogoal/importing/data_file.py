"""From what users have to a data file (Spec B6)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import DATA, create, kind_of
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset, write_dataset
from hypogoal.domains.base import IMPORTED
from hypogoal.importing.arrays import read_arrays
from hypogoal.importing.assemble import assemble
from hypogoal.importing.episodes import recorded_parts
from hypogoal.importing.labels import rule_of, with_labels
from hypogoal.importing.pictures import TWO, read_pictures
from hypogoal.importing.recordings import reader_of
from hypogoal.importing.taken import Taking


def import_data(
    source: Path,
    out: Path,
    *,
    sub_goals: Sequence[str] = (),
    labels: Mapping[str, str] | None = None,
    keys: Sequence[str] = (),
    share: float = 0.2,
    sides: Mapping[str, int] | None = None,
    every: int = 1,
    stack: bool = False,
    group: str = "",
    domain: str = IMPORTED,
    seed: int = 0,
    force: bool = False,
) -> list[str]:
    """Write the states of ``source`` into the data file ``out``; returns lines on what may surprise.

    ``source`` is a ``.npz`` file, a folder of ``.npy`` files, a folder of pictures, or episodes: Minari's, a
    LeRobotDataset, robomimic's HDF5, a folder of films. Or it is a data file, and ``labels`` maps its sub-goal to a
    table of states, which move to the labelled ones.

    Args:
        sub_goals: names, in the order of the labels' columns.
        labels: of episodes, what labels each sub-goal: :func:`hypogoal.importing.labels.rule_of`.
        keys: parts of the episodes' observations, all by default.
        share: of the labelled states, held out where none are given.
        sides: see :class:`Taking`.
        every: take each n-th frame of episodes, and the last.
        stack: see :class:`Taking`.
        group: the array by which labelled states belong together.
        domain: the environment, for later stages.

    Raises:
        UserError: if something cannot be read, or not be used, or ``out`` exists.
    """
    rules, taking = labels or {}, Taking(sides or {}, stack)
    if not source.exists():
        raise UserError("no such file or folder", source, "Give one that there is.")
    inputs = [source] if source.is_file() else []
    with create(out, kind=DATA, config={"domain": domain}, seed=seed, inputs=inputs, force=force) as draft:
        file = draft.files / out.name
        if inputs and kind_of(source) == DATA:
            if sub_goals or keys or every > 1 or group or taking != Taking() or domain != IMPORTED:
                do = "Give --label NAME=TABLE.csv and --out alone."
                raise UserError("a data file is taken as it is", source, do)
            return _label(source, file, rules, seed)
        left: Counter[str] = Counter()
        of_pictures = any((source / kind).is_dir() for kind in TWO)
        reader = None if of_pictures else reader_of(source)
        if reader is None and (rules or keys or every > 1):
            raise UserError("this is no recording", source, "--label, --key and --every are for episodes.")
        if group and (reader or of_pictures):
            do = "Episodes, and folders within positive/ and negative/, are groups already."
            raise UserError("--group is for arrays", source, do)
        remarks: list[str] = []
        if reader:
            by_goal = {goal: rule_of(rule) for goal, rule in rules.items()}
            recordings = reader(source, keys, left)
            parts, remarks = recorded_parts(source, recordings, by_goal, taking, keys=keys, every=every, seed=seed)
        elif of_pictures:
            parts = read_pictures(source, taking, left)
            sub_goals = sub_goals or (source.resolve().name,)
        else:
            parts = read_arrays(source, group)
        if left:
            remarks.append(f"not read: {', '.join(f'{count} {suffix}' for suffix, count in sorted(left.items()))}")
        collected, more = assemble(parts, sub_goals, taking, share=share, seed=seed)
        arguments = {
            "labels": dict(rules),
            "resize": dict(taking.sides),
            "every": every if every > 1 else 0,
            "group": group,
        }
        config: dict[str, Any] = {"source": source.name}
        config |= {name: value for name, value in arguments.items() if value}
        write_dataset(file, collected, domain=domain, config=config, seed=seed)
        return remarks + more


def _label(source: Path, file: Path, rules: Mapping[str, str], seed: int) -> list[str]:
    """Write a data file's states again, with those labelled that a table labels."""
    dataset = open_dataset(source)
    if len(rules) != 1:
        raise UserError("a data file has labels already", source, "Give --label NAME=TABLE.csv for more of them.")
    [(sub_goal, table)] = rules.items()
    collected, count = with_labels(dataset, Path(table), sub_goal)
    config = dataset.config | {"marked": dataset.config.get("marked", 0) + count}
    write_dataset(file, collected, domain=dataset.domain, config=config, seed=seed)
    if len(collected.unlabelled.labels):
        return []
    line = f"no unlabelled state is left in {file.name}: members cannot be made to differ"
    return [f"{line}. Leave some without a label, train with --unlabelled OTHER.h5, or with --set diversity=none."]
