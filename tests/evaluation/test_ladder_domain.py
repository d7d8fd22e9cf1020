"""Spec F1, F3, F4: what the evaluation asks of a domain with rooms, Montezuma's Revenge has."""

import numpy as np
import pytest
from ladder_run import COLUMNS
from toy_data import write_table

from hypogoal.domains.base import load_domain
from hypogoal.evaluation.distance import last_executions, rows_of_ladder
from hypogoal.evaluation.house import joined
from hypogoal.options.tables import Executions


@pytest.mark.atari
def test_the_real_rooms_are_drawn_with_the_real_distances(tmp_path):
    """Spec F3, F4: of 2-6 the top, the base and half-way: 0 only at the base, drawn in two rooms inside the picture."""
    domain = load_domain("montezuma")
    stops = np.array([(2, 77, 235), (6, 77, 235), (6, 77, 250), (6, 79, 237), (6, 80, 237)])
    away = domain.distance_to("climb-down-ladder", stops)
    rows = [(n, 0, 9, 1, 0, 0, *stop, distance) for n, (stop, distance) in enumerate(zip(stops, away, strict=True))]
    write_table(tmp_path / "executions.csv", COLUMNS, rows)
    own = Executions.read(tmp_path / "executions.csv")
    assert own.distance[1] == 0
    assert own.distance[0] > own.distance[2] > 4
    assert last_executions(own)["reached_base"].tolist() == [False, True, False, True, False]
    config = {"sub_goals": domain.sub_goals[:1], "members": 1, "mask_reached": False, "start": "2-6"}
    place = {"method": "one classifier", "N": 2, "ladder": "2-6", "seed": 0, "artefact": "options"}
    rows = joined(rows_of_ladder(own, config, {}, place))
    assert rows[rows["quantity"] == "distance"]["value"].tolist() == pytest.approx([away.mean()])
    pictures = [domain.picture(room) for room in (2, 6)]
    pixels = np.asarray(domain.pixel(np.stack([own.room, own.x, own.y], axis=1)))
    assert all(picture.shape == (210, 160, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert (pictures[0] != pictures[1]).any()
    assert (pixels >= 0).all() and (pixels < [160, 210]).all()
