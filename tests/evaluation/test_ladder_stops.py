"""Figure 5's measures on stops whose true values are forced: ``studies.ladder_stops``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hypogoal.evaluation.distance import BEGAN_INSIDE, HIT, MISS
from hypogoal.options.tables import Executions
from studies.ladder_stops import LADDER, gather, read, spread, tables


def executions(distances: tuple[list[int], list[int]]) -> Executions:
    """Two members' executions, member by member; the second of member 1 begins inside, and all stop in room 9."""
    option = np.repeat([0, 1], [len(each) for each in distances])
    count = len(option)
    inside = np.zeros(count, bool)
    inside[len(distances[0]) + 1] = True
    zeros, distance = np.zeros(count, int), [*distances[0], *distances[1]]
    return Executions.cast(
        zeros, option, zeros + 5, zeros == 0, inside, zeros > 0, zeros + 9, zeros + 77, zeros + 235, distance
    )


def test_the_best_member_is_taken_with_what_became_of_its_executions(tmp_path: Path) -> None:
    """Beginning inside counts 300, so that the first member is best although the second one stops nearer."""
    folder = tmp_path / "executions"
    folder.mkdir()
    for seed, distances in ((10, ([0, 0, 90], [0, 0, 0])), (11, ([90, 90, 90], [0, 0]))):
        executions(distances).write(folder)
        (folder / Executions.FILE).rename(folder / f"options-2-dbat-{seed}-{LADDER}-40000.csv")
    (folder / "options-1-dbat-10-3-9-40000.csv").write_text("another number of groups")
    gather(folder, tmp_path / "stops.csv")
    stops = read(tmp_path / "stops.csv")
    assert sorted(stops[("dbat", 10)][:, 3].tolist()) == sorted([HIT, HIT, MISS])
    assert sorted(stops[("dbat", 11)][:, 3].tolist()) == [MISS] * 3, "90 on average is less than 0 and 300"
    lines = [line for line in tables(tmp_path / "stops.csv") if line.startswith("| D-BAT")]
    assert lines == ["| D-BAT | 10 | 0.67 | 0.00 | 0.0 |", "| D-BAT | 11 | 0.00 | 0.00 | 0.0 |"]
    assert BEGAN_INSIDE not in stops[("dbat", 10)][:, 3]


def test_spread_is_about_the_middle_of_the_room_with_most_stops() -> None:
    """One place: 0. Four corners of a square of side 2: 2 each. Stops in another room do not count."""
    corners = np.array([[3, x, y, MISS] for x in (0, 2) for y in (0, 2)])
    assert spread(corners[:1]) == 0
    assert spread(corners) == pytest.approx(2.0)
    assert spread(np.concatenate([corners, [[9, 200, 200, HIT]]])) == pytest.approx(2.0)
