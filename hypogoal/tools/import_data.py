"""The command that makes a data file of what users have."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.command.call import NO_TRAINING, Call, Done
from hypogoal.command.stage import stage
from hypogoal.core.errors import UserError
from hypogoal.core.progress import say

SOURCE = "Arrays, pictures, or episodes (Minari, LeRobot, robomimic, films)."
NAME = "The sub-goal's name; one per column of the labels, in order."
RULES = "Episodes: a column, last:N frames, FILE.csv, module:function; data file: FILE.csv."
SHAPED = "If rewards are above 0 before success, too, name a column of success or give FILE.csv in place of last:N."
LABEL = f"{RULES} {SHAPED}"
SIDE = "Most pixels on the longer side of pictures; 0: as many as given."
GROUP = "Arrays: which one says what states belong together; held out whole."
NAMING = "Recordings are labelled by --label NAME=RULE, arrays and pictures have --sub-goal NAME."


def _label(text: str) -> tuple[str, str]:
    """Return ``NAME=RULE`` as a pair."""
    name, _, rule = text.partition("=")
    if not (name and rule):
        raise UserError("--label needs NAME=RULE", text, "For example --label won=next.success.")
    return name, rule


@stage(
    "import states.npz --sub-goal door-open --out data/own.h5",
    leaves_out=(*NO_TRAINING, "preset", "resume"),
)
def import_data(
    call: Call,
    source: Annotated[Path, Argument(help=SOURCE)],
    *,
    sub_goal: Annotated[list[str] | None, Option(help=NAME)] = None,
    label: Annotated[list[Any] | None, Option(parser=_label, metavar="NAME=RULE", help=LABEL)] = None,
    key: Annotated[list[str] | None, Option(help="Episodes: which observation to take; repeatable.")] = None,
    every: Annotated[int, Option(min=1, help="Episodes: take every N-th frame.")] = 1,
    heldout: Annotated[float, Option(min=0.01, max=0.9, help="Share of labelled states to hold out.")] = 0.2,
    resize: Annotated[int, Option(min=0, help=SIDE)] = 0,
    group: Annotated[str, Option(help=GROUP)] = "",
    stack: Annotated[bool, Option("--stack", metavar="", help="Axes of frames and colours become channels.")] = False,
    domain: Annotated[str, Option(help="Where the states come from, for train-options.")] = "imported",
) -> Done:
    """Make a data file of your arrays, pictures or recorded episodes.

    ``source`` is a ``.npz`` file, a folder of ``.npy`` files, a folder of pictures, or episodes. Episodes are Minari's,
    a LeRobotDataset, robomimic's HDF5 or a folder of films; ``label`` has the rules by which they are labelled. If
    ``source`` is a data file, ``label`` names a table of its states, which become labelled states.
    """
    from hypogoal import look
    from hypogoal.core.artefacts import DATA, kind_of
    from hypogoal.data import write_dataset
    from hypogoal.domains.find import IMPORTED
    from hypogoal.importing.assemble import assemble
    from hypogoal.importing.labels import add_labels, labels_of
    from hypogoal.importing.pictures import POSITIVE, read_pictures
    from hypogoal.importing.recordings import episodes_of, read_arrays, reader_of
    from hypogoal.importing.states import frames_of

    if not source.exists():
        raise UserError("no such file or folder", source, "Give one that there is.")
    rules = dict(label or ())
    how: dict[str, Any] = {"keys": tuple(key or ()), "every": every, "resize": resize, "stack": stack}
    inputs = [source] if source.is_file() else []
    with call.draft(DATA, {"domain": domain}, inputs) as draft:
        file = draft.files / call.out.name
        if inputs and kind_of(source) == DATA:
            is_as_it_is = how == frames_of.__kwdefaults__ and domain == IMPORTED
            if len(rules) != 1 or sub_goal or group or not is_as_it_is:
                raise UserError("a data file is taken as it is", source, "Give --label NAME=TABLE.csv and --out alone.")
            [(name, table)] = rules.items()
            remarks = add_labels(source, file, name, Path(table), call.seed)
        else:
            of_pictures = (source / POSITIVE).is_dir()
            left: Counter[str] = Counter()  # counts of what is not read, by kind
            reader = None if of_pictures else reader_of(source, left)
            if bool(rules) != bool(reader) or (rules and sub_goal):
                fault = "this is no recording" if rules and not reader else "nothing says where the sub-goal holds"
                raise UserError(fault, source, NAMING)
            if group and (reader or of_pictures):
                raise UserError("--group is for arrays", source, "Episodes and folders are groups already.")
            features: list[str] = []
            if reader:
                episodes = reader(source, how["keys"])
                goals = [*rules]
            elif of_pictures:
                goals = sub_goal or [source.resolve().name]
                episodes = read_pictures(source, goals[0], left)
            else:
                arrays = read_arrays(source, left)
                goals = sub_goal or arrays["sub_goals"].tolist()
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
                share=heldout,
                seed=call.seed,
            )
            config = {"source": source.name, "labels": rules, "group": group, **how}
            write_dataset(file, collected, domain=domain, config=config, seed=call.seed)
            if left:
                counts = ", ".join(f"{count} {kind}" for kind, count in sorted(left.items()))
                remarks = [f"not read: {counts}", *remarks]
    for line in remarks:
        say(f"hypogoal: {line}", err=True)
    details = look.describe(call.out)
    run = "{run}" if call.out.name == "data.h5" else "runs/{out.stem}"
    return Done(
        [f"states: {details['observations']}", *look.outcome(details)],
        then=f"train-ensemble {{out}} --out {run}/ensemble",
    )
