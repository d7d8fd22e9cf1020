"""Scenes over textures: the same features, no tiles."""

from __future__ import annotations

import numpy as np
import pytest

from hypogoal.cli import main
from hypogoal.which_feature.states import FACTORS, SIDE, labelled_states
from hypogoal.which_feature.textures import LARGEST, textured

COUNT = 60


def pair(factor: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scenes without a factor, the same with it, and the other factors: all that is random is drawn alike."""
    factors = np.random.default_rng(0).random((COUNT, len(FACTORS))) < 0.5
    drawn = []
    for holds in (False, True):
        factors[:, FACTORS.index(factor)] = holds
        drawn.append(textured(factors, FACTORS, np.random.default_rng(1)).observations.astype(int))
    return drawn[0], drawn[1], factors


def extent(changed: np.ndarray) -> tuple[int, int]:
    """First and last column in which a picture (48, 48) changed."""
    columns = np.flatnonzero(changed.any(0))
    return columns[0], columns[-1]


@pytest.mark.parametrize("factor", ["colour", "shape"])
def test_the_object_changes_where_it_is(factor: str) -> None:
    """Within its half, in a square of its size; red turns blue, and a ball is fuller than a key."""
    without, having, factors = pair(factor)
    for before, after, place in zip(without, having, factors[:, FACTORS.index("place")], strict=True):
        changed = (before != after).any(-1)
        first, last = extent(changed)
        assert last - first < LARGEST and np.ptp(np.flatnonzero(changed.any(1))) < LARGEST
        assert (first >= SIDE // 2) if place else (last < SIDE // 2)
        if factor == "colour":
            assert (before - after)[changed][:, 0].sum() > 0 > (before - after)[changed][:, 2].sum()


def test_place_moves_the_object_by_half_a_picture() -> None:
    """Left and right change, whatever else there is."""
    without, having, _ = pair("place")
    for before, after in zip(without, having, strict=True):
        first, last = extent((before != after).any(-1))
        assert first < SIDE // 2 <= last


def test_many_boxes_are_two_more() -> None:
    """Something is added in every picture, and the texture between stays."""
    without, having, _ = pair("count")
    changed = (without != having).any(-1)
    assert changed.any((1, 2)).all()
    assert changed.mean() < 0.2


def test_no_patch_comes_twice() -> None:
    """So there is no dictionary of tiles; the same seed draws the same bytes, another one others."""
    first, again, other = (labelled_states(40, seed, FACTORS, textured).observations for seed in (3, 3, 4))
    assert first.dtype == np.uint8 and first.shape == (40, SIDE, SIDE, 3)
    assert first.tobytes() == again.tobytes() != other.tobytes()
    patches = first.reshape(40, 6, 8, 6, 8, 3).swapaxes(2, 3).reshape(-1, 192)
    assert len(np.unique(patches, axis=0)) == len(patches)


def test_the_benchmark_draws_them(tmp_path, capsys) -> None:
    """From the command line, with as many states as wanted; two frames are refused."""
    command = ["benchmark", "which-feature", "--scenes", "textures", "--seeds", "0", "--diversity", "none", "--quiet"]
    few = ["--set", "steps=2", "--set", "labelled=64", "--set", "unlabelled=64"]
    assert main([*command, *few, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "results.csv").read_text().count("\n") == 17
    assert main([*command, "--factors", "moved", "--out", str(tmp_path / "moved")]) == 2
    assert "moved needs two frames of tiles" in capsys.readouterr().err
