"""Contradictory labels and test pictures that are hardly new, found when states are imported (Spec B6, B3)."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from PIL import Image
from test_import import arrays, at_right, pictures, save_images, save_minari

from hypogoal.cli import main
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.own_data.minari import read_minari
from hypogoal.own_data.parts import Parts, collected_of


def warned_of(**changes: np.ndarray) -> list[str]:
    return collected_of(Parts(**arrays(**changes)), ())[1]


def smooth(count: int, seed: int = 5) -> np.ndarray:
    """Pictures like photographs, uint8 (count, 96, 128, 3)."""
    small = np.random.default_rng(seed).integers(50, 200, (count, 6, 8, 3), dtype=np.uint8)
    return np.stack([np.asarray(Image.fromarray(each).resize((128, 96), Image.Resampling.BICUBIC)) for each in small])


def test_pictures_with_both_labels_are_counted_and_two_named(tmp_path: Path) -> None:
    """Spec B6: of files by their names, of arrays by their rows, of each sub-goal; the import goes on."""
    folder = save_images(tmp_path / "at-right")
    for name in ("01", "03", "05"):
        shutil.copy(folder / "positive" / f"{name}.png", folder / "negative" / f"copy-{name}.png")
    said = run("import", folder, "--out", tmp_path / "data.h5", "-q").err
    assert "3 pictures carry both labels of at-right, such as positive/" in said and " and negative/copy-0" in said
    assert open_dataset(tmp_path / "data.h5").counts()["labelled"]["at-right"] == {"states": 27, "positives": 12}
    images, labels = pictures(40)
    twice = {"observations": np.concatenate([images, images[7:8]]), "labels": np.append(labels, not labels[7])}
    pair = "observations[7] and observations[40]" if labels[7] else "observations[40] and observations[7]"
    text = f"1 picture carries both labels of sub-goal, such as {pair}: no member can be right about both"
    assert warned_of(**twice) == [text]
    both = Parts(**arrays(**twice | {"labels": np.stack([np.arange(41) % 3 == 0, twice["labels"]], 1),
                                     "heldout_labels": np.stack([np.arange(16) % 2] * 2, 1)}))  # fmt: skip
    assert collected_of(both, ("third", "right"))[1] == [text.replace("of sub-goal", "of right")]


def test_labelled_and_held_out_pictures_contradict_each_other_too() -> None:
    """Spec B6: a held-out copy is left out, as ever; that its label was another is said."""
    (images, _), (held, known) = pictures(40), pictures(16, 2)
    warned = warned_of(heldout_observations=np.concatenate([held, images[:2]]), heldout_labels=np.append(known, [1, 1]))
    assert warned == [
        "1 picture carries both labels of sub-goal, such as heldout_observations[16] and observations[0]: no member "
        "can be right about both",
        "2 of 18 held-out states look like one to learn from: they are left out",
    ]


@pytest.mark.parametrize("only", [True, False])
def test_a_class_without_a_picture_of_its_own_is_refused(tmp_path: Path, only: bool) -> None:
    """Spec B6, G2: all pictures twice; or every positive, or negative, a copy of some other; nothing is written."""
    images, labels = pictures(40)
    with pytest.raises(
        UserError, match=r"every positive of sub-goal is also a negative: for example observations\[0\]"
    ):
        warned_of(observations=np.concatenate([images, images]), labels=np.arange(80) < 40)
    kept = labels if only else ~labels
    copied = {"observations": np.concatenate([images, images[kept]]), "labels": np.append(labels, ~labels[kept])}
    kind, other = ("positive", "negative") if only else ("negative", "positive")
    with pytest.raises(UserError, match=f"every {kind} of sub-goal is also a {other}: .* Remove the copies"):
        warned_of(**copied)
    with pytest.raises(UserError, match=f"every {kind} of sub-goal is also a {other}"):
        warned_of(**copied, heldout_observations=None, heldout_labels=None)
    folder = save_images(tmp_path / "goal")
    for file in (folder / kind).iterdir():
        shutil.copy(file, folder / other / f"copy-{file.name}")
    assert main(["import", str(folder), "--out", str(tmp_path / "data.h5")]) == 2
    assert not (tmp_path / "data.h5").exists()


def test_numbers_and_episodes_are_looked_at_too(tmp_path: Path) -> None:
    """Spec B6: equal rows of numbers; Minari's states have episodes and steps for names."""
    rng = np.random.default_rng(0)
    rows, others, held = rng.normal(size=(40, 5)), rng.normal(size=(20, 5)), rng.normal(size=(16, 5))
    rows[20] = rows[1]
    assert any(
        "1 observation carries both labels of sub-goal, such as observations[1] and observations[20]" in line
        for line in warned_of(observations=rows, unlabelled=others, heldout_observations=held)
    )
    parts = read_minari(save_minari(tmp_path / "own-v0"), [at_right])
    assert {parts.name("observations", row).partition(", ")[2] for row in range(24)} == {f"step {n}" for n in range(6)}
    for field, states in (("observations", parts.observations), ("heldout_observations", parts.heldout_observations)):
        for row in (0, 7, 11):
            episode, step = parts.name(field, row).removeprefix("episode_").split(", step ")
            np.testing.assert_array_equal(states[row], pictures(6, int(episode))[0][int(step)])


def as_jpeg(picture: np.ndarray) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=60)
    return np.asarray(Image.open(file))


def shaken(picture: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 6, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def brighter(picture: np.ndarray) -> np.ndarray:
    return picture + np.uint8(15)


def touched(picture: np.ndarray) -> np.ndarray:
    changed = picture.copy()
    changed[50, 60] = 255 - changed[50, 60]
    return changed


@pytest.mark.parametrize("change", [as_jpeg, shaken, brighter, touched])
def test_near_duplicates_are_told(change) -> None:
    """Spec B3: a held-out picture that is a labelled one saved anew, with noise, brighter, or but for a pixel."""
    images, others, held = smooth(40), smooth(6, 6), smooth(10, 7)
    kept = {
        "observations": images,
        "labels": np.arange(40) % 2,
        "unlabelled": others,
        "heldout_labels": np.arange(10) % 2,
    }
    assert warned_of(**kept, heldout_observations=held) == []
    held[[2, 5]] = change(images[12]), change(images[30])
    [line] = warned_of(**kept, heldout_observations=held)
    assert line.startswith(
        "2 of 10 held-out pictures nearly equal a labelled one, such as heldout_observations[2] and "
    )
    assert "observations[12] (in 16 x 16 areas their brightness differs by at most 8 of 255 levels)" in line
    images[20] = change(images[7])
    lines = warned_of(**kept, heldout_observations=smooth(10, 7))
    assert len(lines) == 1 and lines[0].startswith("1 of 20 positives of sub-goal nearly equal a negative, such as ")
    assert "such as observations[7] and observations[20] (in 16" in lines[0]


def test_states_that_differ_in_a_small_thing_are_no_duplicates() -> None:
    """Spec B3: an object elsewhere, all of it brighter by far: that is what labels are of."""
    states = np.repeat(smooth(1), 40, axis=0)
    for place, state in enumerate(states):
        cell = state[10 * (place // 8) : 10 * (place // 8) + 8, 12 * (place % 8) : 12 * (place % 8) + 8]
        cell[:] = np.where(cell < 128, cell + 80, cell - 80)
    kept = {"labels": np.arange(30) % 2, "unlabelled": smooth(6, 6), "heldout_labels": np.arange(10) % 2}
    assert warned_of(**kept, observations=states[:30], heldout_observations=states[30:]) == []
    grey = np.repeat(np.arange(0, 200, 5, np.uint8), 48 * 48).reshape(40, 48, 48)
    dark, bright = grey[:15], grey[25:]
    lines = warned_of(
        observations=np.concatenate([dark, bright]), labels=np.arange(30) < 15, unlabelled=grey[15:20],
        heldout_observations=255 - grey[:10], heldout_labels=np.arange(10) % 2,
    )  # fmt: skip
    assert not any("nearly equal a negative" in line for line in lines)
