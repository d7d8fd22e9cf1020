"""Frames, checked and split into the sets of a data file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected, Integers, Labels, States, doubts_of, require_classes
from hypogoal.importing.episodes import ROLES, Array
from hypogoal.importing.files import reading
from hypogoal.importing.states import Frame
from hypogoal.importing.taken import together
from hypogoal.observations import digest, packed

ROW = "row"  # the origin of each state: its place in its set
SPLIT = np.array([0.4, 0.4, 0.2])  # shares of episodes that are labelled, unlabelled and held out
MORE = "Give more, at least three episodes that are labelled; rows and pictures have their sets by name."
REMARK = "no held-out states were given: {} of the labelled ones are held out, which says nothing about other contexts"


def assemble(
    source: Path,
    frames: Sequence[Frame],
    goals: Sequence[str],
    features: Sequence[str] = (),
    *,
    share: float = 0.2,
    seed: int = 0,
) -> tuple[Collected, list[str]]:
    """The states in the form of a data file, and lines on what is allowed but may surprise.

    Without held-out states, a ``share`` of each class of the labelled ones, or of their groups, is held out by
    ``seed``. Unusable states, and a class that is missing or only has states that the other class has too, are a
    ``UserError``.
    """
    labelled, unlabelled, heldout = split(frames, seed, source)
    names = [frame.name for frame in frames]
    first = frames[0]
    for frame in frames:
        if frame.seen.keys() != first.seen.keys():
            fault = "episodes have different observations"
            raise UserError(fault, f"{first.name}, {frame.name}", "Choose some by --key.")
    parts, channels, remarks = {}, {}, []
    for key in first.seen:
        states = [frame.seen[key] for frame in frames]
        short = key.replace("/", ".") if len(first.seen) > 1 else ""
        parts[short] = together(states, names, key or "the observations")
        stack = first.channels[key]
        if stack:
            channels[short] = stack
    with reading(source, "Give keys that can be file names."):
        observations = parts[""] if "" in parts else packed(parts)
    count = observations[0].size
    if features and len(features) != count:
        raise UserError(f"{len(features)} names of features do not fit", f"{count} numbers", "Give one for each.")
    labels = np.array([frame.labels for frame in frames])
    looks = np.array([digest(state).hex() for state in observations])
    remarks += contradictions(names, labels, looks, goals, labelled, heldout)
    learned = np.concatenate([labelled, unlabelled])
    if not len(heldout):
        groups = np.array([frame.group for frame in frames])
        is_held = _held_out(labels[labelled], groups[labelled], looks[labelled], share, seed)
        heldout, labelled = labelled[is_held], labelled[~is_held]
        learned = labelled
        remarks.append(REMARK.format(len(heldout)))
        of_unlabelled = groups[unlabelled]
        alike = np.isin(of_unlabelled, groups[heldout]) & (of_unlabelled != "")
        unlabelled = _without(unlabelled, alike, "unlabelled states are of held-out groups", remarks)
    alike = np.isin(looks[heldout], looks[learned])
    heldout = _without(heldout, alike, "held-out states look like ones to learn from", remarks)
    alike = np.isin(looks[unlabelled], looks[heldout])
    unlabelled = _without(unlabelled, alike, "unlabelled states look like ones held out", remarks)
    require_classes(labels[labelled], goals, None, "Give states of both kinds.")
    remarks += doubts_of(labels[labelled], labels[heldout], goals)
    sets = []
    for rows in (labelled, unlabelled, heldout):
        origins = {ROW: np.arange(len(rows))}
        sets.append(States(observations[rows], labels[rows], origins))
    collected = Collected(
        observations.shape[1:],
        tuple(goals),
        labelled=sets[0],
        unlabelled=sets[1],
        heldout=sets[2],
        features=tuple(features),
        channels=channels,
    )
    return collected, remarks


def contradictions(
    names: Sequence[str],
    labels: Labels,
    looks: Array,
    goals: Sequence[str],
    labelled: Integers,
    heldout: Integers,
) -> list[str]:
    """A line for each sub-goal with equal states whose labels differ; a ``UserError`` if a class has no others.

    ``names``, ``labels`` (N, G) and ``looks``, equal where states are, are of all states, the last two rows of some.
    """
    judged = np.concatenate([labelled, heldout])
    lines = []
    for goal, column in zip(goals, labels.T, strict=True):
        both = _ambiguous(looks, column, judged)
        if not len(both):
            continue
        alike = judged[looks[judged] == both[0]]
        example = " and ".join(names[row] for row in alike)
        learned = _ambiguous(looks, column, labelled)
        clear = labelled[~np.isin(looks[labelled], learned)]
        where = f"without those that have both labels, such as {example}"
        require_classes(column[clear, None], [goal], where, "Remove the copies whose label is wrong.")
        fault = f"{len(both)} times equal states have both labels of {goal}"
        lines.append(f"{fault}: no member can be right about {example}")
    return lines


def _ambiguous(looks: Array, labels: Labels, rows: Integers) -> Array:
    """The looks of states, some rows of all, that carry both labels."""
    positive = labels[rows]
    return np.intersect1d(looks[rows[positive]], looks[rows[~positive]])


def split(frames: Sequence[Frame], seed: int, source: Path) -> list[Integers]:
    """The rows of frames that are labelled, unlabelled and held out.

    Whole episodes whose role is open are drawn for those of the three that have no frames yet, ``SPLIT`` of them each.
    """
    sets: dict[str, list[int]] = {role: [] for role in ROLES}
    free: dict[str, list[int]] = {}
    for row, frame in enumerate(frames):
        if frame.role:
            sets[frame.role].append(row)
        else:
            free.setdefault(frame.episode, []).append(row)
    if free:
        are_empty = [not rows for rows in sets.values()]
        shares = np.cumsum(SPLIT * are_empty)
        ends = shares[:2] / shares[2] * len(free)
        episodes = [*free.values()]
        order = rng_for(seed, "minari").permutation(len(free))
        parts = np.split(order, np.round(ends).astype(int))
        for role, drawn in zip(ROLES, parts, strict=True):
            for episode in drawn:
                sets[role] += episodes[episode]
    needed = ROLES if free else ROLES[:2]
    for role in needed:
        if not sets[role]:
            raise UserError(f"there are no {role} states", source, MORE)
    return [np.array(rows, np.int64) for rows in sets.values()]


def _without(
    rows: Integers,
    left: Labels,
    reason: str,
    remarks: list[str],
) -> Integers:
    """The rows that are not ``left`` out, which is said with the reason; if none is kept: a ``UserError``."""
    if left.all():
        raise UserError(f"all {len(rows)} {reason}", None, "Give some of other contexts.")
    if left.any():
        remarks.append(f"{left.sum()} of {len(rows)} {reason}: they are left out")
    return rows[~left]


def _held_out(
    labels: Labels,
    groups: Array,
    looks: Array,
    share: float,
    seed: int,
) -> Labels:
    """Which states are held out, bool (N,): whole groups, and without groups all that look alike."""
    alike = np.where(groups == "", looks, groups)
    _, first, unit = np.unique(alike, return_index=True, return_inverse=True)
    kinds = labels[first]
    if groups.any():  # which labels a group has
        rows = []
        for group in range(len(first)):
            some = labels[unit == group]
            rows.append([*some.any(axis=0), *some.all(axis=0)])
        kinds = np.array(rows)
    order = np.argsort(first)  # each once, in the original order
    chosen = held_out(kinds[order], share, seed)
    held = np.zeros(len(first), np.bool_)
    held[order[chosen]] = True
    return held[unit]


def held_out(labels: Labels, share: float, seed: int) -> Labels:
    """Which states are held out, bool (N,): a random ``share`` of each combination of labels (N, G), never all of it.

    A remainder of less than one state is carried over to the next combination. No state at all is a ``UserError``.
    """
    rng = rng_for(seed, "held-out")
    chosen = np.zeros(len(labels), np.bool_)
    due = 0.0
    for kind in np.unique(labels, axis=0):
        rows = np.flatnonzero((labels == kind).all(axis=1))
        due += share * len(rows)
        taken = min(round(due), len(rows) - 1)
        chosen[rng.permutation(rows)[:taken]] = True
        due -= taken
    if not chosen.any():
        do = "Give held-out states, a larger --heldout, or more labelled ones."
        raise UserError(f"none of {len(labels)} labelled states, or groups of them, can be held out", None, do)
    return chosen
