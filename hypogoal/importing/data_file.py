"""From what users have to a data file (Spec B6)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from hypogoal.core.artefacts import DATA, create, kind_of
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset, reading, require_names, write_dataset
from hypogoal.domains.base import IMPORTED
from hypogoal.importing.arrays import episodes_of, read_arrays
from hypogoal.importing.assemble import assemble
from hypogoal.importing.files import AGAIN
from hypogoal.importing.labels import rule_of, with_labels
from hypogoal.importing.pictures import POSITIVE, read_pictures
from hypogoal.importing.recordings import reader_of
from hypogoal.importing.states import frames_of


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
        keys: parts of the observations, all by default.
        share: of the labelled states, held out where none are given.
        sides: most pixels on the longer side of pictures, by key; "" is of all that have none of their own.
        every: take each n-th frame of episodes, and the last.
        stack: axes of frames and colours become channels.
        group: the array by which labelled states belong together.
        domain: the environment, for later stages.

    Raises:
        UserError: if something cannot be read, or not be used, or ``out`` exists.
    """
    if not source.exists():
        raise UserError("no such file or folder", source, "Give one that there is.")
    rules = dict(labels or {})
    inputs = [source] if source.is_file() else []
    with create(out, kind=DATA, config={"domain": domain}, seed=seed, inputs=inputs, force=force) as draft:
        file = draft.files / out.name
        if inputs and _is_data_file(source):
            if sub_goals or group or keys or sides or stack or every > 1 or domain != IMPORTED:
                do = "Give --label NAME=TABLE.csv and --out alone."
                raise UserError("a data file is taken as it is", source, do)
            return _label(source, file, rules, seed)
        of_pictures = (source / POSITIVE).is_dir()
        reader = None if of_pictures else reader_of(source)
        refusals = (
            (rules and sub_goals, "--label names the sub-goals", "Leave out --sub-goal."),
            (not reader and (rules or every > 1), "this is no recording", "--label and --every are for episodes."),
            (group and (reader or of_pictures), "--group is for arrays", "Episodes and folders are groups already."),
        )
        for applies, fault, do in refusals:
            if applies:
                raise UserError(fault, source, do)
        left: Counter[str] = Counter()
        features: list[str] = []
        if reader:
            episodes = reader(source, keys, left)
            goals = [*rules]
        elif of_pictures:
            goals = [*sub_goals] or [source.resolve().name]
            episodes = read_pictures(source, goals[0], left)
        else:
            arrays = read_arrays(source, group)
            goals = [*sub_goals] or arrays["sub_goals"][""].tolist()
            features = arrays["features"][""].tolist()
            episodes = episodes_of(arrays, goals, group, source)
        if goals:
            require_names(goals)
        by_goal = {goal: rule_of(rules.get(goal, goal)) for goal in goals}  # columns are named after their sub-goals
        frames = frames_of(
            source,
            episodes,
            by_goal,
            left,
            keys=keys,
            every=every,
            sides=sides,
            stack=stack,
        )
        collected, remarks = assemble(source, [*frames], goals, features, share=share, seed=seed)
        arguments = {
            "source": source.name,
            "labels": rules,
            "resize": sides,
            "every": every if every > 1 else 0,
            "group": group,
        }
        config = {name: value for name, value in arguments.items() if value}
        write_dataset(file, collected, domain=domain, config=config, seed=seed)
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(left.items()))
        return [f"not read: {counts}", *remarks] if left else remarks


def _is_data_file(source: Path) -> bool:
    """Whether a file is one of hypogoal's; recordings are HDF5, too."""
    if kind_of(source) != DATA:
        return False
    with reading(source, "the file", AGAIN) as file:
        return "sub_goals" in file.attrs


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
