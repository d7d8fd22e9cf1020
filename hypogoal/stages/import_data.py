"""Spec B6: import of users' states into a data file, and export of a data file's states as arrays."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import DATA, create, kind_of
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import load
from hypogoal.core.seeding import torch_generator
from hypogoal.core.terminal import say
from hypogoal.data import Collected, open_dataset, write_dataset
from hypogoal.domains.base import IMPORTED, defaults_of
from hypogoal.own_data.arrays import read_arrays
from hypogoal.own_data.images import read_images
from hypogoal.own_data.lerobot import INFO, LeRobot
from hypogoal.own_data.marks import with_marks
from hypogoal.own_data.minari import MINARI, read_minari
from hypogoal.own_data.parts import Resize, collected_of, resize_of
from hypogoal.own_data.recordings import Recording, recorded_parts
from hypogoal.own_data.robomimic import Robomimic
from hypogoal.own_data.videos import SUFFIX, Videos

LABELS = "hypogoal.labels"  # entry points of label functions


def import_data(
    source: Path,
    out: Path,
    *,
    sub_goals: Sequence[str] = (),
    labels: Mapping[str, str] | None = None,
    keys: Sequence[str] = (),
    share: float = 0.2,
    resize: Resize = 0,
    every: int = 1,
    stack: bool = False,
    domain: str = IMPORTED,
    seed: int = 0,
    force: bool = False,
) -> dict[str, Any]:
    """Write the states of ``source`` into the data file ``out``; returns numbers of states and positives.

    ``source`` is a ``.npz`` file, a folder of ``.npy`` files, a folder of images, or episodes: a folder with a Minari
    dataset, a LeRobotDataset or mp4 files, or an HDF5 file of robomimic's. Or it is a data file, and ``labels`` maps
    its sub-goal to a table of :mod:`hypogoal.own_data.marks`, whose states move to the labelled ones. ``sub_goals`` are
    names in the order of the labels' columns. For episodes ``labels`` maps sub-goals to what labels them: in a Minari
    dataset ``module:function``, from an observation to a truth value, else see :func:`recorded_parts`; ``keys`` select
    parts of observations, and ``every`` n-th frame is taken. Without held-out states a ``share`` of the labelled ones
    is held out by ``seed``. ``resize``: at most so many pixels on the longer side of pictures; 0: unchanged. ``stack``:
    axes of frames and colours become channels. ``domain`` is for later stages. Errors: see ``hypogoal.own_data``.
    """
    rules = labels or {}
    inputs = [source] if source.is_file() else []
    with create(out, kind=DATA, config={"domain": domain}, seed=seed, inputs=inputs, force=force) as draft:
        file = draft.files / out.name
        if source.is_file() and kind_of(source) == DATA:
            if sub_goals or keys or resize or every > 1 or stack or domain != IMPORTED:
                raise UserError("a data file is taken as it is", source, "Give --label NAME=TABLE.csv and --out alone.")
            _write_marked(source, file, rules, seed=seed)
            return open_dataset(file).counts()
        if (source / MINARI).exists():
            functions = [load(name, "label function", LABELS, {}) for name in rules.values()]
            parts, sub_goals = read_minari(source, functions, keys=keys, seed=seed), tuple(rules)
        elif (recording := recording_of(source, keys, resize)) is not None:
            parts, sub_goals = recorded_parts(recording, rules, every=every, seed=seed), ()
        elif rules or keys or every > 1:
            do = "--label, --key and --every are for Minari, LeRobot and robomimic datasets, and folders of mp4 files."
            raise UserError("this is no recording", source, do)
        elif (source / "positive").is_dir() or (source / "negative").is_dir():
            parts = read_images(source, resize=resize_of(resize, "", picture=True), stack=stack)
            sub_goals = sub_goals or (source.resolve().name,)
        else:
            parts = read_arrays(source)
        collected, warned = collected_of(parts, sub_goals, share=share, seed=seed, resize=resize, stack=stack)
        warned += _too_small(domain, collected)
        for line in warned:
            say(f"hypogoal: {line}", err=True)
        config: dict[str, Any] = {"source": source.name}
        config |= ({"labels": dict(rules)} if rules else {}) | ({"resize": resize} if resize else {})
        config |= {"every": every} if every > 1 else {}
        write_dataset(file, collected, domain=domain, config=config, seed=seed)
        return open_dataset(file).counts()


def _write_marked(source: Path, file: Path, rules: Mapping[str, str], *, seed: int) -> None:
    """Write a data file's states again, with those labelled that a table labels."""
    dataset = open_dataset(source)
    if len(rules) != 1:
        raise UserError("a data file has labels already", source, "Give --label NAME=TABLE.csv for more of them.")
    [(sub_goal, table)] = rules.items()
    collected, count = with_marks(dataset, Path(table), sub_goal)
    if not len(collected.unlabelled.labels):
        line = f"no unlabelled state is left in {file.name}: members cannot be made to differ"
        do = "Leave some without a label, train with --unlabelled OTHER.h5, or with --set diversity=none"
        say(f"hypogoal: {line}. {do}.", err=True)
    config = dataset.config | {"marked": dataset.config.get("marked", 0) + count}
    write_dataset(file, collected, domain=dataset.domain, config=config, seed=seed)


def recording_of(source: Path, keys: Sequence[str], resize: Resize) -> Recording | None:
    """The episodes of a LeRobotDataset, robomimic's HDF5 or a folder of mp4 files; None if it is none of them."""
    if (source / INFO).exists():
        return LeRobot(source, keys, resize)
    if source.suffix in (".h5", ".hdf5"):
        return Robomimic(source, keys, resize)
    return Videos(source, keys, resize) if any(source.glob(f"*{SUFFIX}")) else None


def _too_small(domain: str, states: Collected) -> list[str]:
    """The error that ``train-ensemble`` will raise for such images with its default network, if any."""
    from hypogoal.hypotheses.config import EnsembleConfig
    from hypogoal.hypotheses.networks import build_network, network_for

    name = defaults_of(domain, "train-ensemble").get("network", EnsembleConfig().network)
    name = network_for(name, states.labelled.observations.dtype)
    try:
        dtype = states.labelled.observations.dtype
        build_network(name, states.observation_shape, torch_generator(0, "import"), dtype=dtype)
    except UserError as error:
        return [str(error)]
    return []
