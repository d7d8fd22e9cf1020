"""From what users have to a data file (Spec B6)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import DATA, create, kind_of
from hypogoal.core.errors import UserError
from hypogoal.data import write_dataset
from hypogoal.domains.base import IMPORTED
from hypogoal.importing.arrays import episodes_of, read_arrays
from hypogoal.importing.assemble import assemble
from hypogoal.importing.labels import add_labels, labels_of
from hypogoal.importing.pictures import POSITIVE, read_pictures
from hypogoal.importing.recordings import reader_of
from hypogoal.importing.states import frames_of

NAMING = "Recordings are labelled by --label NAME=RULE, arrays and pictures have --sub-goal NAME."


def import_data(
    source: Path,
    out: Path,
    *,
    sub_goals: Sequence[str] = (),
    rules: Mapping[str, str],
    share: float = 0.2,
    group: str = "",
    domain: str = IMPORTED,
    seed: int = 0,
    force: bool = False,
    **how: Any,
) -> list[str]:
    """Write the states of ``source`` into the data file ``out``; returns lines on what may surprise.

    ``source`` is a ``.npz`` file, a folder of ``.npy`` files, a folder of pictures, or episodes: Minari's, a
    LeRobotDataset, robomimic's HDF5, a folder of films. Or it is a data file, and ``rules`` map its sub-goal to a
    table of states, which move to the labelled ones.

    Args:
        sub_goals: names, in the order of the labels' columns.
        rules: of episodes, what labels each sub-goal: :func:`hypogoal.importing.labels.labels_of`.
        share: of the labelled states, held out where none are given.
        group: the array by which labelled states belong together.
        domain: the environment, for later stages.
        how: which observations of which frames are taken for what: :func:`hypogoal.importing.states.frames_of`.

    Raises:
        UserError: if something cannot be read, or not be used, or ``out`` exists.
    """
    if not source.exists():
        raise UserError("no such file or folder", source, "Give one that there is.")
    inputs = [source] if source.is_file() else []
    with create(
        out,
        kind=DATA,
        config={"domain": domain},
        seed=seed,
        inputs=inputs,
        force=force,
    ) as draft:
        file = draft.files / out.name
        if inputs and kind_of(source) == DATA:
            others = (sub_goals, group, how, domain)
            if len(rules) != 1 or others != ((), "", frames_of.__kwdefaults__, IMPORTED):
                do = "Give --label NAME=TABLE.csv and --out alone."
                raise UserError("a data file is taken as it is", source, do)
            [(sub_goal, table)] = rules.items()
            return add_labels(source, file, sub_goal, Path(table), seed)
        of_pictures = (source / POSITIVE).is_dir()
        reader = None if of_pictures else reader_of(source)
        if bool(rules) != bool(reader) or (rules and sub_goals):
            fault = "this is no recording" if rules and not reader else "nothing says where the sub-goal holds"
            raise UserError(fault, source, NAMING)
        if group and (reader or of_pictures):
            raise UserError("--group is for arrays", source, "Episodes and folders are groups already.")
        left: Counter[str] = Counter()
        features: list[str] = []
        if reader:
            episodes = reader(source, how.get("keys", ()), left)
            goals = [*rules]
        elif of_pictures:
            goals = [*sub_goals] or [source.resolve().name]
            episodes = read_pictures(source, goals[0], left)
        else:
            arrays = read_arrays(source)
            goals = [*sub_goals] or arrays["sub_goals"].tolist()
            features = arrays["features"].tolist()
            episodes = episodes_of(arrays, goals, group, left)
        frames = frames_of(source, episodes, left, **how)
        by_goal = {goal: rules.get(goal, goal) for goal in goals}  # columns are named after their sub-goals
        labels = labels_of(frames, by_goal)
        collected, remarks = assemble(
            source,
            frames,
            labels,
            goals,
            features,
            share=share,
            seed=seed,
        )
        config = {"source": source.name, "labels": rules, "group": group, **how}
        write_dataset(file, collected, domain=domain, config=config, seed=seed)
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(left.items()))
        return [f"not read: {counts}", *remarks] if left else remarks
