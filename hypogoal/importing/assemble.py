"""How frames are checked, and split into the sets of a data file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from pandas import DataFrame

from hypogoal.core.arrays import Bools
from hypogoal.core.errors import UserError
from hypogoal.core.files import reading
from hypogoal.core.seeding import rng_for
from hypogoal.data import GROUP, Collected, States
from hypogoal.importing.states import HELDOUT, LABELLED, ROLES, UNJUDGED, UNLABELLED, Frames, together
from hypogoal.label_checks import doubts_of, require_classes
from hypogoal.observations import digest, packed

ROW = "row"  # the origin that says a state's place in its set
DOUBT = "{} times equal states have both labels of {}: no member can be right about {}"
SPLIT = np.array([0.4, 0.4, 0.2])  # the shares of episodes that become labelled, unlabelled and held out
NOBODY = "{} held-out states have no label: they are left out"
MORE = "Give more, at least three episodes that are labelled; rows and pictures have their sets by name."
REMARK = "no held-out states were given: {} of the labelled ones are held out, which says nothing about other contexts"


def assemble(
    source: Path,
    frames: Frames,
    labels: Bools,
    goals: Sequence[str],
    features: Sequence[str] = (),
    *,
    share: float = 0.2,
    seed: int = 0,
) -> tuple[Collected, list[str]]:
    """Return the states in the form of a data file, and lines on what is allowed but may surprise.

    Without held-out states, a random ``share`` of each class of the labelled states, or of their groups, is held out.
    Raises ``UserError`` if states are unusable, or if a set or a class has no states.
    """
    kept = frames.table["kept"]
    table = frames.table[kept].reset_index(drop=True)
    labels = labels[kept]
    parts = {}
    for key, states in frames.seen.items():
        parts[key] = together(states, table["name"].tolist(), key or "the observations")
    with reading(source, "Give keys that can be file names."):
        observations = packed(parts) if len(parts) > 1 else parts[""]
    count = observations[0].size
    if features and len(features) != count:
        raise UserError(f"{len(features)} names of features do not fit", f"{count} numbers", "Give one for each.")
    table["look"] = [digest(state).hex() for state in observations]
    table = with_roles(table, seed)
    unjudged = table.index[table["role"] == UNJUDGED]
    table = table.drop(unjudged)
    doubts = contradictions(table, labels, goals)
    if len(unjudged):
        doubts.append(NOBODY.format(len(unjudged)))
    table, remarks = apart(table, labels, share, seed)
    in_group = table["group"] != ""
    groups, _ = pd.factorize(table["group"].where(in_group, table["look"]))
    sets = []
    for role in ROLES:
        is_own = table["role"] == role
        rows = table.index[is_own].to_numpy()
        if not rows.size:
            do = "; ".join(remarks) or MORE
            raise UserError(f"there are no {role} states", source, do)
        origins = {ROW: np.arange(len(rows)), GROUP: groups[is_own]}
        sets.append(States(observations[rows], labels[rows], origins))
    labelled, unlabelled, heldout = sets
    require_classes(labelled.labels, goals, None, "Give states of both kinds.")
    collected = Collected(
        observations.shape[1:],
        tuple(goals),
        labelled,
        unlabelled,
        heldout,
        tuple(features),
        frames.channels,
    )
    return collected, doubts + remarks + doubts_of(labelled.labels, heldout.labels, goals)


def contradictions(table: DataFrame, labels: Bools, goals: Sequence[str]) -> list[str]:
    """Return a line for each sub-goal for which equal states have both labels.

    Raises ``UserError`` if the labelled states without such contradictions lack a class.
    """
    lines = []
    judged = table[table["role"] != UNLABELLED]
    for goal, column in zip(goals, labels.T, strict=True):
        marks = pd.Series(column[judged.index], judged.index)
        has_both = marks.groupby(judged["look"]).transform("nunique") > 1
        looks = judged["look"][has_both]
        if looks.empty:
            continue
        alike = judged["name"][judged["look"] == looks.iloc[0]]
        example = " and ".join(alike.groupby(marks).first())
        clear = marks[~has_both & (judged["role"] == LABELLED)].to_numpy()
        where = f"without those that have both labels, such as {example}"
        require_classes(clear[:, None], [goal], where, "Remove the copies whose label is wrong.")
        lines.append(DOUBT.format(looks.nunique(), goal, example))
    return lines


def with_roles(table: DataFrame, seed: int) -> DataFrame:
    """Return ``table``, as :attr:`Frames.table` describes it, with a role for every frame.

    Only roles that no frame has yet are given. They are given to whole episodes at random, in the proportions of
    ``SPLIT``. In the table returned, these episodes stand in the order in which they were drawn.
    """
    is_open = table["role"] == ""
    number_of, episodes = pd.factorize(table["episode"][is_open])
    if not len(episodes):
        return table
    is_missing = ~np.isin(ROLES, table["role"])
    shares = np.cumsum(SPLIT * is_missing)
    whole = shares / shares[2]
    ends = np.round(whole[:2] * len(episodes))
    # The stream's name is for all recordings, not for Minari's alone. With another name, all splits would change.
    order = rng_for(seed, "minari").permutation(len(episodes))
    place = np.argsort(order)[number_of]
    role_of = np.searchsorted(ends, place, side="right")
    table.loc[is_open, "role"] = np.array(ROLES)[role_of]
    table.loc[is_open, "place"] = place
    return table.sort_values("place", kind="stable", na_position="first")


def apart(
    table: DataFrame,
    labels: Bools,
    share: float,
    seed: int,
) -> tuple[DataFrame, list[str]]:
    """Return the frames without those that are in two sets, and lines that say what was done.

    If no state is held out, and no roles were drawn by episode, a ``share`` of the labelled states is held out.
    """
    lines = []
    learned = [LABELLED, UNLABELLED]
    groups = set()
    if HELDOUT not in {*table["role"]} and "place" not in table:
        labelled = table[table["role"] == LABELLED]
        is_held = held_out(labels[labelled.index], labelled, share, seed)
        held = labelled[is_held]
        table.loc[held.index, "role"] = HELDOUT
        groups = {*held["group"]} - {""}
        learned = [LABELLED]
        lines.append(REMARK.format(len(held)))
    for role, others in ((HELDOUT, learned), (UNLABELLED, [HELDOUT])):
        candidates = table[table["role"] == role]
        other = table[table["role"].isin(others)]
        is_known = candidates["look"].isin(other["look"])
        is_grouped = candidates["group"].isin(groups.intersection(other["group"]))
        alike = candidates.index[is_known | is_grouped]
        if len(alike):
            like = " or ".join(others)
            count = f"{len(alike)} of {len(candidates)} {role} states"
            lines.append(f"{count} look like {like} ones, or are of their groups: they are left out")
            table = table.drop(alike)
    return table, lines


def held_out(labels: Bools, table: DataFrame, share: float, seed: int) -> Bools:
    """Draw the states that are held out, bool (N,).

    Whole groups are held out together, and so are states without a group that look alike. For each combination of
    labels (N, G) that groups have, a random ``share`` of these groups is held out, but never all. A remainder of less
    than one group is carried over to the next combination. Raises ``UserError`` if no group can be held out.
    """
    in_group = table["group"] != ""
    unit = table["group"].where(in_group, table["look"])
    units = DataFrame(labels).groupby(unit.to_numpy(), sort=False)
    kinds = units.first()
    if in_group.any():
        kinds = pd.concat([units.any(), units.all()], axis=1)
    of_each = kinds.to_numpy()
    rng = rng_for(seed, "held-out")
    chosen = np.zeros(len(of_each), bool)
    due = 0.0
    for kind in np.unique(of_each, axis=0):
        rows = np.flatnonzero((of_each == kind).all(axis=1))
        due += share * len(rows)
        taken = min(round(due), len(rows) - 1)
        chosen[rng.permutation(rows)[:taken]] = True
        due -= taken
    if not chosen.any():
        do = "Give held-out states, a larger --heldout, or more labelled ones."
        raise UserError(f"none of {len(labels)} labelled states, or groups of them, can be held out", None, do)
    return chosen[units.ngroup()]
