"""States that users bring: arrays, images, Minari's files; what is wrong with them is one line (Spec B6, G2)."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import refuses, run, settings
from PIL import Image

from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.own_data.arrays import read_arrays
from hypogoal.own_data.images import read_image, read_images
from hypogoal.own_data.parts import Parts, collected_of, held_out

SIDE = 48


def pictures(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A white square at the left (label 0) or at the right (1) of grey noise."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 60, size=(count, SIDE, SIDE, 3), dtype=np.uint8)
    labels = np.arange(count) % 2 == 1
    for image, right in zip(images, labels, strict=True):
        image[10:30, (30 if right else 5) : (42 if right else 17)] = 255
    return images, labels


def arrays(**changes: Any) -> dict[str, Any]:
    (images, labels), (others, _), (held, known) = pictures(40), pictures(20, 1), pictures(16, 2)
    whole = {
        "observations": images, "labels": labels, "unlabelled": others, "heldout_observations": held,
        "heldout_labels": known,
    }  # fmt: skip
    return {name: value for name, value in (whole | changes).items() if value is not None}


def test_arrays_go_through_training_and_evaluation(tmp_path: Path) -> None:
    """Spec B6, A2, A5: a .npz becomes a data file, an ensemble of it judges the held-out states."""
    np.savez(tmp_path / "own.npz", **arrays())
    folder = tmp_path / "run"
    data = str(folder / "data.h5")
    run("import", tmp_path / "own.npz", "--out", data, "--sub-goal", "at-right", "-q")
    found = open_dataset(Path(data))
    np.testing.assert_array_equal(found.labelled("at-right").observations, arrays()["observations"])
    assert found.counts()["heldout"]["at-right"] == {"states": 16, "positives": 8}
    train = ["train-ensemble", data, "--out", str(folder / "ensemble"), "-q"]
    few = settings("steps=40", "members=2", "learning_rate=1e-3")
    run(*train, *few)
    run("evaluate", folder, "-q")
    metrics = json.loads((folder / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["hypotheses"][0]["worst"]["mean"] > 0.9


def test_images_too_small_are_warned_of(tmp_path: Path) -> None:
    """Spec B6: when they are imported, not when they are trained on; the network that is named takes them."""
    shrunk = {
        name: values[:, ::2, ::2] for name, values in arrays().items() if name not in ("labels", "heldout_labels")
    }
    np.savez(tmp_path / "small.npz", **arrays(**shrunk))
    data, ensemble = str(tmp_path / "data.h5"), str(tmp_path / "ensemble")
    told = run("import", tmp_path / "small.npz", "--out", data, "-q").err
    assert "the network 'doorkey' does not take these observations: observation shape (24, 24, 3). Give --set" in told
    few = settings("steps=2", "members=1", "network=tiles")
    assert "--set network=tiles" in told
    run("train-ensemble", data, "--out", ensemble, "-q", *few)
    printed = run("import", tmp_path / "small.npz", "--out", tmp_path / "m.h5", "--domain", "montezuma")
    assert "the network 'montezuma' does not take these observations" in printed.err
    np.savez(tmp_path / "own.npz", **arrays())
    assert "does not take" not in run("import", tmp_path / "own.npz", "--out", tmp_path / "large.h5").err


def test_options_of_states_of_no_domain_are_refused(tmp_path: Path) -> None:
    """Spec B6, G2: what to do is said: which domain the states are of is told when they are imported."""
    np.savez(tmp_path / "own.npz", **arrays())
    data, ensemble = str(tmp_path / "data.h5"), str(tmp_path / "ensemble")
    run("import", tmp_path / "own.npz", "--out", data, "-q")
    few = settings("steps=2", "members=1")
    run("train-ensemble", data, "--out", ensemble, "-q", *few)
    command = ["train-options", ensemble, "--out", tmp_path / "options", "-q"]
    refuses("the domain of these imported states is not known: imported. Import them again with --domain", *command)


def test_several_sub_goals_come_out_as_they_went_in(tmp_path: Path) -> None:
    """Spec B6: labels (N, G), a folder of .npy files, and the way back as .npz, names included."""
    labels = np.stack([np.arange(40) % 2, np.arange(40) % 3 == 0], axis=1)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, values in arrays(labels=labels, heldout_labels=np.stack([np.arange(16) % 2] * 2, 1)).items():
        np.save(folder / f"{name}.npy", values)
    data, again = tmp_path / "data.h5", tmp_path / "again.h5"
    names = ["--sub-goal", "odd", "--sub-goal", "third"]
    run("import", folder, "--out", data, *names, "-q")
    run("export", data, "--out", tmp_path / "out.npz")
    run("import", tmp_path / "out.npz", "--out", again, "-q")
    one, other = open_dataset(data), open_dataset(again)
    assert one.sub_goals == other.sub_goals == ("odd", "third")
    for split in ("labelled", "heldout"):
        for goal in one.sub_goals:
            left, right = getattr(one, split)(goal), getattr(other, split)(goal)
            np.testing.assert_array_equal(left.observations, right.observations)
            np.testing.assert_array_equal(left.labels, right.labels)
    refuses("exists already", "export", data, "--out", tmp_path / "out.npz")
    refuses("as .npz", "export", data, "--out", tmp_path / "out.csv")


def test_a_share_is_held_out_where_nothing_else_is_given(tmp_path: Path) -> None:
    """Spec B3: of each class, and it is said that this tells nothing of other contexts."""
    np.savez(tmp_path / "own.npz", **arrays(heldout_observations=None, heldout_labels=None))
    data = tmp_path / "data.h5"
    said = run("import", tmp_path / "own.npz", "--out", data, "--heldout", "0.25", "-q")
    assert "says nothing about other contexts" in said.err
    counts = open_dataset(data).counts()
    assert counts["heldout"]["sub-goal"] == {"states": 10, "positives": 5}
    assert counts["labelled"]["sub-goal"] == {"states": 30, "positives": 15}


def test_a_share_is_held_out_of_many_small_groups_too() -> None:
    """Spec B3: what is too little of one combination of labels goes on to the next; never all of one, never nothing."""
    labels = np.array([[bit >> goal & 1 for goal in range(6)] for bit in range(64)] * 2, dtype=np.bool_)
    chosen = held_out(labels, 0.2, seed=0)
    assert chosen.sum() == 26
    left = {tuple(row) for row in labels[~chosen].tolist()}
    assert len(left) == 64
    rare = np.arange(30) == 7
    assert not held_out(rare[:, None], 0.9, seed=0)[7]
    with pytest.raises(UserError, match=r"none of 64 labelled states can be held out: heldout=0\.2"):
        held_out(labels[:64], 0.2, seed=0)


def test_held_out_states_that_are_known_are_left_out() -> None:
    """Spec B3: members are not judged by what they learned; how many were left out is said."""
    (images, _), (others, _), (held, known) = pictures(40), pictures(20, 1), pictures(16, 2)
    mixed = arrays(heldout_observations=np.concatenate([images[:3], held, others[:4]]))
    parts = Parts(**mixed | {"heldout_labels": np.concatenate([[0, 1, 0], known, [0, 1, 0, 1]])})
    collected, warned = collected_of(parts, ())
    assert warned == ["7 of 23 held-out states look like one to learn from: they are left out"]
    np.testing.assert_array_equal(collected.heldout.observations, held)
    np.testing.assert_array_equal(collected.heldout.labels[:, 0], known)
    with pytest.raises(UserError, match="every held-out state looks like one to learn from"):
        collected_of(Parts(**mixed | {"heldout_observations": images, "heldout_labels": arrays()["labels"]}), ())


def test_a_share_that_is_held_out_is_of_pictures() -> None:
    """Spec B3: what looks alike is held out together, from the unlabelled states too."""
    (images, labels), (others, _) = pictures(20), pictures(10, 1)
    parts = Parts(np.tile(images, (3, 1, 1, 1)), np.tile(labels, 3), np.concatenate([others, images]))
    collected, warned = collected_of(parts, (), share=0.2)
    sets = [collected.labelled, collected.unlabelled, collected.heldout]
    known = [{image.tobytes() for image in one.observations} for one in sets]
    assert [len(one.labels) for one in sets] == [48, 26, 12] and [len(one) for one in known] == [16, 26, 4]
    assert not (known[0] | known[1]) & known[2]
    assert "4 of 30 unlabelled states look like one held out: they are left out" in warned
    with pytest.raises(UserError, match="every unlabelled state looks like one held out"):
        collected_of(replace(parts, unlabelled=collected.heldout.observations), (), share=0.2)


def test_unbalanced_classes_are_warned_of() -> None:
    """Spec B6."""
    labels = np.arange(40) < 3
    _, warned = collected_of(Parts(pictures(40)[0], labels, *(arrays()[name] for name in list(arrays())[2:])), ())
    assert warned == ["sub-goal has 3 positives among 40 labelled states: classes are unbalanced"]


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"unlabelled": None}, "no array 'unlabelled'"),
    ({"unlabelled": None, "unlabeled": pictures(5)[0]}, "unknown array 'unlabeled': .* Did you mean 'unlabelled'"),
    ({"held_out_labels": np.zeros(3)}, "unknown array 'held_out_labels': .* Did you mean 'heldout_labels'"),
    ({"rewards": np.zeros(3)}, "unknown array 'rewards': .* Known are observations, labels, unlabelled"),
    ({"heldout_labels": None}, "held-out states need observations and labels"),
    ({"observations": pictures(40)[0] / 255}, "differ in shape or type from the labelled ones: uint8"),
    ({"observations": np.full((40, 9), np.nan)}, "have numbers that are not finite"),
    ({"features": np.array(["a"])}, "number of feature names is wrong: 1 for uint8"),
    ({"observations": pictures(40)[0].astype(int) * 9}, "could be pictures or numbers.*Give pictures as uint8"),
    ({"observations": pictures(40)[0].transpose(0, 3, 1, 2)}, r"frames, first.*stacked frames among the channels"),
    ({"unlabelled": np.zeros((60, 12, 48, 48), np.uint8)}, r"frames, first: uint8 \(60, 12, 48, 48\)"),
    ({"observations": np.zeros((40, 0), np.uint8)}, "are not observations"),
    ({"unlabelled": np.zeros((5, 9, 9, 3), np.uint8)}, "differ in shape or type from the labelled ones"),
    ({"unlabelled": pictures(0)[0]}, "the unlabelled observations are empty"),
    ({"labels": np.arange(39) % 2}, "do not fit 40 states"),
    ({"labels": np.zeros(0)}, "do not fit 40 states"),
    ({"sub_goals": np.array([b"won"])}, r"sub_goals are \|S3, not texts"),
    ({"sub_goals": np.array(["a:b"])}, "a sub-goal's name must be usable as a file name: 'a:b'"),
    ({"labels": np.arange(40) % 3}, r"are not only 0 and 1: \[2\]"),
    ({"labels": np.full(40, np.nan)}, "are not only 0 and 1"),
    ({"labels": np.zeros(40)}, "has no positives among 40 labelled states"),
    ({"labels": np.ones(40)}, "has no negatives among 40 labelled states"),
    ({"labels": np.stack([np.arange(40) % 2] * 2, 1)}, "2 sub-goals need as many names"),
    ({"heldout_labels": np.stack([np.arange(16) % 2] * 2, 1)}, "are of 2 sub-goals, not 1"),
    ({"labels": np.array([None] * 40)}, "Python objects"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_what_is_wrong_with_arrays_is_one_line(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Spec G2: shapes, types, label values; no pickle is read."""
    np.savez(tmp_path / "own.npz", **arrays(**changes))
    with pytest.raises(UserError, match=message):
        collected_of(read_arrays(tmp_path / "own.npz"), ())
    if all(values.dtype != object for values in arrays(**changes).values()):  # which .npy would hold as a pickle
        for name, values in arrays(**changes).items():
            np.save(tmp_path / f"{name}.npy", values)
        with pytest.raises(UserError, match=message):
            collected_of(read_arrays(tmp_path), ())


def test_damaged_arrays_are_one_line(tmp_path: Path) -> None:
    """Spec G2."""
    path = tmp_path / "own.npz"
    path.write_bytes(b"PK" + b"x" * 100)
    with pytest.raises(UserError, match=r"not a \.npz file"):
        read_arrays(path)
    np.savez(path, **arrays())
    whole = bytearray(path.read_bytes())
    whole[2000:4000] = bytes(2000)
    path.write_bytes(whole)
    with pytest.raises(UserError, match="damaged"):
        read_arrays(path)
    with pytest.raises(UserError, match="missing"):
        read_arrays(tmp_path / "nowhere.npz")


def packed(path: Path, method: int = zipfile.ZIP_DEFLATED) -> bytearray:
    """An honest ``.npz`` file, packed by hand."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, values in arrays().items():
            made = io.BytesIO()
            np.save(made, values)
            archive.writestr(f"{name}.npy", made.getvalue())
    return bytearray(path.read_bytes())


def everywhere(data: bytearray, mark: bytes, offset: int, value: int) -> None:
    """Change a byte of every entry of a zip file."""
    at = data.find(mark)
    while at >= 0:
        data[at + offset] = value
        at = data.find(mark, at + 4)


def test_zip_files_that_numpy_does_not_write_are_one_line(tmp_path: Path) -> None:
    """Spec G2: encrypted, packed by methods that make gigabytes of a kilobyte or are unknown, two files in one."""
    path = tmp_path / "own.npz"
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        packed(path, method)
        with pytest.raises(UserError, match=r"not packed as numpy packs them: .*own\.npz"):
            read_arrays(path)
    for offset, value in ((8, 1), (10, 99)):  # flags, method
        data = packed(path)
        everywhere(data, b"PK\x01\x02", offset, value)
        everywhere(data, b"PK\x03\x04", offset - 2, value)
        path.write_bytes(data)
        with pytest.raises(UserError, match="not packed as numpy packs"):
            read_arrays(path)
    data = packed(path, zipfile.ZIP_STORED)
    np.save(tmp_path / "one.npy", arrays()["labels"])
    path.write_bytes((tmp_path / "one.npy").read_bytes() + data)
    with pytest.raises(UserError, match="damaged"):
        read_arrays(path)
    data = packed(path)
    data[200:400] = bytes(b"\xff" * 200)
    path.write_bytes(data)
    with pytest.raises(UserError, match="damaged"):
        read_arrays(path)
    for header in (b"(" * 99 + b"\n", b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }\n" % 10**30):
        huge = b"\x93NUMPY\x02\0" + len(header).to_bytes(4, "little") + header
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("observations.npy", huge)
        with pytest.raises(UserError, match="damaged"):
            read_arrays(path)
    for name in ("positive", "negative", "unlabelled"):
        (tmp_path / "images" / name).mkdir(parents=True)
        (tmp_path / "images" / name / "x.npy").write_bytes(huge)
    with pytest.raises(UserError, match="not an image, or it is damaged"):
        read_images(tmp_path / "images")


def test_a_name_that_is_no_utf_8_is_imported(tmp_path: Path) -> None:
    """Spec B6: what the source was called is only told; what of it cannot be is a '?'."""
    np.savez(tmp_path / "own\udcff.npz", **arrays())
    run("import", tmp_path / "own\udcff.npz", "--out", tmp_path / "data.h5", "-q")
    assert open_dataset(tmp_path / "data.h5").config["source"] == "own?.npz"


def save_images(folder: Path, *, held: bool = True, grey: bool = False) -> Path:
    images, labels = pictures(24)
    for number, (image, label) in enumerate(zip(images, labels, strict=True)):
        names = ["positive" if label else "negative", *(["unlabelled"] if number % 3 == 0 else [])]
        _save(image, [folder / name / f"{number:02d}.png" for name in names], grey)
    for number, (image, label) in enumerate(zip(*pictures(6 * held, 2), strict=True)):
        _save(image, [folder / "heldout" / ("positive" if label else "negative") / f"{number:02d}.png"], grey)
    return folder


def _save(image: np.ndarray, paths: list[Path], grey: bool) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image[..., 0] if grey else image).save(path)


def test_folders_of_images_become_states(tmp_path: Path) -> None:
    """Spec B6: the folder's name is the sub-goal's; grey images have one channel; the ensemble trains."""
    data, out = str(tmp_path / "data.h5"), str(tmp_path / "ensemble")
    folder = save_images(tmp_path / "at-right")
    run("import", folder, "--out", data, "-q")
    found = open_dataset(Path(data))
    assert found.sub_goals == ("at-right",)
    images, labels = pictures(24)
    np.testing.assert_array_equal(found.labelled("at-right").observations[:12], images[labels])
    assert found.counts()["heldout"]["at-right"] == {"states": 6, "positives": 3}
    run("train-ensemble", data, "--out", out, "--set", "steps=2", "--set", "members=2", "-q")
    assert read_images(save_images(tmp_path / "grey", grey=True)).observations.shape == (24, SIDE, SIDE, 1)


def test_what_is_wrong_with_images_is_one_line(tmp_path: Path) -> None:
    """Spec G2: the file is named."""
    folder = save_images(tmp_path / "images")
    Image.new("RGB", (20, SIDE)).save(folder / "positive" / "zz.png")
    with pytest.raises(UserError, match=r"the image is 48 x 20, others are 48 x 48: .*zz\.png"):
        read_images(folder)
    (folder / "positive" / "zz.png").write_bytes(b"no image")
    with pytest.raises(UserError, match=r"not an image, or it is damaged: .*zz\.png"):
        read_images(folder)
    Image.fromarray(np.full((SIDE, SIDE), 40_000, np.uint16)).save(folder / "positive" / "zz.png")
    with pytest.raises(UserError, match=r"the image has the mode I;16, not 8 bits a channel: .*zz\.png"):
        read_images(folder)
    for mode in ("RGBA", "LA"):
        Image.new("RGB", (SIDE, SIDE), 255).convert(mode).save(folder / "positive" / "zz.png")
        assert read_image(folder / "positive" / "zz.png").shape == (SIDE, SIDE, 3)
        Image.new(mode, (SIDE, SIDE)).save(folder / "positive" / "zz.png")
        with pytest.raises(UserError, match=r"the image is transparent in places: .*zz\.png"):
            read_images(folder)
    for file in (folder / "unlabelled").iterdir():
        file.unlink()
    with pytest.raises(UserError, match=r"no images .*unlabelled"):
        read_images(folder)


def test_what_is_no_picture_of_a_state_is_not_even_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Spec G2: PostScript, for which Pillow would run a program; huge pictures; pipes; several pictures in one."""
    file = tmp_path / "x.png"
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    file.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n")
    with pytest.raises(UserError, match=r"not an image, or it is damaged: .*x\.png"):
        read_image(file)
    assert not (tmp_path / "ran").exists()
    Image.new("1", (13_000, 13_000)).save(file)
    with pytest.raises(UserError, match=r"the image has 169,000,000 pixels, at most 16,777,216 are read: .*x\.png"):
        read_image(file)
    frames = [Image.new("L", (SIDE, SIDE), value) for value in (0, 90, 180)]
    for suffix in (".gif", ".png", ".webp"):
        frames[0].save(tmp_path / f"several{suffix}", save_all=True, append_images=frames[1:])
        with pytest.raises(UserError, match=rf"one file holds several pictures: .*several\{suffix}"):
            read_image(tmp_path / f"several{suffix}")
    assert not list(recwarn)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(UserError, match=r"the image is not a regular file: .*x\.png"):
        read_image(file)


def save_minari(
    folder: Path, episodes: int = 10, *, nested: bool = False, stored: str = "hdf5", side: int = SIDE
) -> Path:
    """A dataset in Minari's own layout (0.5): data/metadata.json, and a group per episode in data/main_data.hdf5."""
    (folder / "data").mkdir(parents=True)
    about = {"data_format": stored, "total_episodes": episodes}
    (folder / "data" / "metadata.json").write_text(json.dumps(about))
    with h5py.File(folder / "data" / "main_data.hdf5", "w", track_order=True) as file:
        for number in range(episodes):
            group = file.create_group(f"episode_{number}")
            images = pictures(6, number)[0].repeat(side // SIDE, 1).repeat(side // SIDE, 2)
            if nested:
                group.create_dataset("observations/image", data=images, chunks=True, maxshape=(None, *images.shape[1:]))
            else:
                group.create_dataset("observations", data=images, chunks=True, maxshape=(None, *images.shape[1:]))
            group.create_dataset("actions", data=np.zeros(5, np.int64))
    return folder


def at_right(observation: np.ndarray) -> bool:
    scale = len(observation) // SIDE
    return bool(observation[20 * scale, 35 * scale, 0] == 255)


def is_unsure(observation: np.ndarray) -> Any:
    return np.nan


def is_told(observation: np.ndarray) -> Any:
    return "False"


def fails(observation: np.ndarray) -> bool:
    return bool(observation["nothing"])


@pytest.mark.parametrize("nested", [False, True])
def test_minari_datasets_are_labelled_by_a_function(tmp_path: Path, nested: bool) -> None:
    """Spec B6: whole episodes are labelled, unlabelled or held out, the same for the same seed."""
    folder, data = save_minari(tmp_path / "own-v0", nested=nested), tmp_path / "data.h5"
    given = ["import", str(folder), "--out", str(data), "--label", "right=test_import:at_right", "-q"]
    given += ["--key", "image"] if nested else []
    run(*given)
    counts = open_dataset(data).counts()
    assert counts["labelled"]["right"] == {"states": 24, "positives": 12}
    assert counts["heldout"]["right"] == {"states": 12, "positives": 6}
    assert counts["unlabelled"] == 24
    before = open_dataset(data).unlabelled()
    run(*given, "--force")
    np.testing.assert_array_equal(open_dataset(data).unlabelled(), before)
    assert open_dataset(data).config["labels"] == {"right": "test_import:at_right"}


def goes_right(observation: dict[str, np.ndarray]) -> bool:
    return at_right(observation["image"])


def test_several_keys_of_a_minari_dataset(tmp_path: Path) -> None:
    """Spec H6: pictures beside numbers; the label function gets a dictionary of them."""
    folder, data = save_minari(tmp_path / "own-v0", nested=True), tmp_path / "data.h5"
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        for number in range(10):
            file[f"episode_{number}/observations/speed"] = np.arange(12.0).reshape(6, 2)
    words = ["import", str(folder), "--out", str(data), "--label", "right=test_import:goes_right", "-q"]
    run(*words, "--key", "image", "--key", "speed")
    states = open_dataset(data).labelled("right")
    assert states.observations["image"].shape == (24, SIDE, SIDE, 3)
    assert states.labels.sum() == 12 and set(states.observations["speed"][:, 0]) == {0, 2, 4, 6, 8, 10}


def test_what_is_wrong_with_minari_is_one_line(tmp_path: Path) -> None:
    """Spec G2."""
    label = ["--label", "right=test_import:at_right"]
    cases = [
        (save_minari(tmp_path / "a"), [], "has no labels"),
        (save_minari(tmp_path / "b"), ["--label", "right"], "--label needs NAME=RULE"),
        (save_minari(tmp_path / "c", nested=True), label, "Give --key, one of image"),
        (save_minari(tmp_path / "d", stored="arrow"), label, "'arrow' is not read"),
        (save_minari(tmp_path / "e", 2), label, "2 episodes cannot be"),
        (save_minari(tmp_path / "f"), [*label, "--key", "x"], "no readable 'episode_0/observations/x'"),
        (save_images(tmp_path / "g"), label, "this is no recording"),
        (
            save_minari(tmp_path / "h"),
            ["--label", "right=test_import:fails"],
            "the label function fails raised IndexError: ",
        ),
        *(
            (
                save_minari(tmp_path / name),
                ["--label", f"right=test_import:{name}"],
                f"the label function {name} gave the label {value}: test_import.py, line ",
            )
            for name, value in (("is_unsure", "nan"), ("is_told", "'False'"))
        ),
    ]
    for name, shape in (("i", (6, SIDE, 20, 3)), ("j", (6, SIDE)), ("k", ())):
        cases.append((save_minari(tmp_path / name), label, "its episodes have observations of different shapes"))
        with h5py.File(tmp_path / name / "data" / "main_data.hdf5", "a") as file:
            del file["episode_3/observations"]
            file["episode_3/observations"] = np.ones(shape, np.uint8)
    for folder, more, message in cases:
        refuses(message, "import", folder, "--out", tmp_path / "data.h5", *more)
        assert not (tmp_path / "data.h5").exists()
