"""Pictures as viewers show them, and made smaller on the way in (Spec B6)."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from PIL import Image
from test_import import arrays, pictures, save_images, save_minari

from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.own_data.images import read_image, read_images
from hypogoal.own_data.parts import Parts, collected_of

UPRIGHT = np.random.default_rng(0).integers(0, 255, (3, 5, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
STORED = {  # by what EXIF calls the visual place of row 0 and column 0
    1: UPRIGHT,  # top, left
    2: UPRIGHT[:, ::-1],  # top, right
    3: UPRIGHT[::-1, ::-1],  # bottom, right
    4: UPRIGHT[::-1],  # bottom, left
    5: UPRIGHT.swapaxes(0, 1),  # left, top
    6: UPRIGHT[:, ::-1].swapaxes(0, 1),  # right, top
    7: UPRIGHT[::-1, ::-1].swapaxes(0, 1),  # right, bottom
    8: UPRIGHT[::-1].swapaxes(0, 1),  # left, bottom
}


def exif_of(orientation: int, order: str = "<") -> bytes:
    """EXIF with one entry, in either order of bytes."""
    head = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}HI", 42, 8)
    return head + struct.pack(f"{order}HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)


def saved(file: Path, stored: np.ndarray, exif: bytes) -> Path:
    more = {} if file.suffix == ".png" else {"quality": 95} if file.suffix == ".jpg" else {"lossless": True}
    Image.fromarray(np.ascontiguousarray(stored)).save(file, exif=b"Exif\0\0" + exif, **more)
    return file


def check_upright(file: Path) -> None:
    seen, wanted = read_image(file), UPRIGHT[..., :1] if "grey" in file.name else UPRIGHT
    assert seen.shape == wanted.shape
    off = np.abs(seen.astype(int) - wanted)[4::16, 4::16]  # away from the edges, over which JPEG smears colours
    assert off.max() <= (40 if file.suffix == ".jpg" else 0)


@pytest.mark.parametrize("orientation", STORED)
def test_an_image_is_upright(tmp_path: Path, orientation: int) -> None:
    """Spec B6: as the EXIF orientation says, in all formats that have it, in colour and grey, in every reader."""
    for number, suffix in enumerate((".jpg", ".png", ".webp")):
        exif = exif_of(orientation, "<>"[number % 2])
        check_upright(saved(tmp_path / f"colour{suffix}", STORED[orientation], exif))
        if suffix != ".webp":
            check_upright(saved(tmp_path / f"grey{suffix}", STORED[orientation][..., 0], exif))
    whole = (tmp_path / "colour.png").read_bytes()
    chunk = exif_of(orientation)
    chunk = struct.pack(">I", len(chunk)) + b"eXIf" + chunk + struct.pack(">I", zlib.crc32(b"eXIf" + chunk))
    plain = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(STORED[orientation])).save(plain, "PNG")
    assert whole.count(b"eXIf") == 1 and plain.getvalue().count(b"eXIf") == 0
    (tmp_path / "late.png").write_bytes(plain.getvalue()[:-12] + chunk + plain.getvalue()[-12:])  # behind the pixels
    check_upright(tmp_path / "late.png")
    palette = Image.fromarray(np.ascontiguousarray(STORED[orientation])).quantize(15)
    palette.save(tmp_path / "palette.png", exif=exif_of(orientation))
    check_upright(tmp_path / "palette.png")
    for name in ("positive", "negative", "unlabelled"):
        (tmp_path / "goal" / name).mkdir(parents=True)
        saved(tmp_path / "goal" / name / "1.png", STORED[orientation], exif_of(orientation))
    np.testing.assert_array_equal(read_images(tmp_path / "goal").observations, [UPRIGHT, UPRIGHT])


def test_an_orientation_that_is_none_is_ignored(tmp_path: Path) -> None:
    """Spec G2: of no known value, or in metadata that are damaged, as viewers do."""
    for exif in (exif_of(0), exif_of(9), exif_of(65_535), b"", b"II*\0\xff\xff\xff\xff", exif_of(6)[:12], b"nonsense"):
        for suffix in (".jpg", ".png", ".webp"):
            check_upright(saved(tmp_path / f"x{suffix}", UPRIGHT, exif))


def test_pictures_of_any_source_are_made_smaller(tmp_path: Path) -> None:
    """Spec B6: their longer side has so many pixels, areas are averaged; what is small enough stays as it is."""
    images, _ = pictures(24)
    small = images.reshape(24, 24, 2, 24, 2, 3).mean((2, 4))
    np.savez(tmp_path / "own.npz", **arrays())
    sources = [save_images(tmp_path / "at-right"), tmp_path / "own.npz", save_minari(tmp_path / "own-v0")]
    for number, source in enumerate(sources):
        given = ["--label", "right=test_import:at_right"] if number == 2 else []
        out = tmp_path / f"{number}.h5"
        run("import", source, "--out", out, "--resize", "24", *given, "-q")
        data = open_dataset(out)
        assert data.observation_shape == (24, 24, 3) and data.config["resize"] == 24
        if number == 0:
            positives = small[np.arange(24) % 2 == 1]
            assert np.abs(data.labelled("at-right").observations[:12] - positives).max() <= 1
    for longest in (48, 100):
        assert collected_of(Parts(**arrays()), (), resize=longest)[0].observation_shape == (48, 48, 3)
    tall = {name: x[:, :, :20] if x.ndim == 4 else x for name, x in arrays().items()}
    assert collected_of(Parts(**tall), (), resize=24)[0].observation_shape == (24, 10, 3)
    numbers = {name: x.reshape(len(x), -1)[:, :9] if x.ndim == 4 else x for name, x in arrays().items()}
    with pytest.raises(UserError, match=r"only pictures can be resized: uint8 \(40, 9\)\. Leave out --resize"):
        collected_of(Parts(**numbers), (), resize=24)


def test_images_of_several_sizes_are_one_size_when_made_smaller(tmp_path: Path) -> None:
    """Spec B6: where their sides have one proportion; and marks are pictures like others."""
    folder = save_images(tmp_path / "goal")
    large = Image.open(folder / "positive" / "01.png").resize((96, 96))
    large.save(folder / "positive" / "01.png")
    with pytest.raises(UserError, match="the image is 48 x 48, others are 96 x 96"):
        read_images(folder)
    assert read_images(folder, resize=30).observations.shape == (24, 30, 30, 3)
    large.resize((96, 48)).save(folder / "positive" / "01.png")
    with pytest.raises(UserError, match="the image is 30 x 30, others are 15 x 30"):
        read_images(folder, resize=30)


def test_stacks_of_frames_are_files_of_arrays(tmp_path: Path) -> None:
    """Spec B6: a ``.npy`` file each; they keep their channels, and are made smaller like pictures."""
    states = np.random.default_rng(0).integers(0, 255, (6, 64, 48, 4), dtype=np.uint8)
    for number, state in enumerate(states):
        folder = tmp_path / "goal" / ("positive", "negative", "unlabelled")[number % 3]
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{number}.npy", state)
    parts = read_images(tmp_path / "goal")
    np.testing.assert_array_equal(parts.observations, states[[0, 3, 1, 4]])
    np.testing.assert_array_equal(parts.unlabelled, states[[2, 5]])
    given = ["--heldout", "0.4", "--resize", "16", "-q"]
    run("import", tmp_path / "goal", "--out", tmp_path / "goal.h5", *given)
    wanted = states[[2, 5]].reshape(2, 16, 4, 12, 4, 4).mean((2, 4))
    assert np.abs(open_dataset(tmp_path / "goal.h5").unlabelled() - wanted).max() <= 1
    many = np.random.default_rng(0).integers(0, 255, (4, 48, 60, 3), dtype=np.uint8)
    for name in ("positive", "negative", "unlabelled"):
        (tmp_path / "stacks" / name).mkdir(parents=True)
        np.save(tmp_path / "stacks" / name / "1.npy", many)
    with pytest.raises(
        UserError, match=r"states are stacks of pictures: .*1\.npy, uint8 \(4, 48, 60, 3\)\. Give pictures as uint8"
    ):
        read_images(tmp_path / "stacks")
    stacked = read_images(tmp_path / "stacks", stack=True).unlabelled[0]
    np.testing.assert_array_equal(stacked, np.concatenate([*many], -1))


@pytest.mark.parametrize("kind", ["folder", "arrays", "minari"])
def test_large_pictures_are_proposed_to_be_made_smaller(tmp_path: Path, kind: str) -> None:
    """Spec B6, G1: in a line that is a command and works as it stands; never of what is small, or was made so."""

    def large(states: np.ndarray) -> np.ndarray:
        return states.repeat(5, 1).repeat(4, 2) if states.ndim == 4 else states

    source, given, name = tmp_path / "it's at the right", ["--sub-goal", "at right"], "at right"
    if kind == "folder":
        for file in save_images(source).rglob("*.png"):
            Image.fromarray(large(np.asarray(Image.open(file))[None])[0]).save(file)
    elif kind == "arrays":
        source = source.with_suffix(".npz")
        few = {name: states for name, states in arrays().items() if "heldout" not in name}
        np.savez(source, **{name: large(states) for name, states in few.items()})
        given += ["--heldout", "0.3", "--seed", "4", "--domain", "montezuma"]
    else:
        save_minari(source, side=240)
        given, name = ["--label", "right=test_import:at_right"], "right"
    out = tmp_path / "large ones.h5"
    said = run("import", source, "--out", out, *given)
    [line] = [line for line in said.err.splitlines() if "--resize" in line]
    shape = (240, 240, 3) if kind == "minari" else (240, 192, 3)
    sizes = " x ".join(map(str, shape))
    assert f"pictures of {sizes} need much memory and time; add --resize 160 --force" in line
    assert said.out.startswith(f"taken for pictures, {sizes} uint8\n")
    before = open_dataset(out)
    labels = before.labelled(name).labels
    assert before.observation_shape == shape
    assert "--resize" not in run("import", source, "--out", out, *given, *line.partition("add ")[2].split()).err
    after = open_dataset(out)
    assert after.observation_shape == (160, 160 if kind == "minari" else 128, 3)
    for mine in ("domain", "seed", "sub_goals"):
        assert getattr(before, mine) == getattr(after, mine)
    np.testing.assert_array_equal(labels, after.labelled(name).labels)
