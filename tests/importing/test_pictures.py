"""Pictures as viewers show them, folders of them, and films turned as players turn them (Spec B6)."""

import io
from collections import Counter
from pathlib import Path

import numpy as np
from command_line import refuses, run
from PIL import Image

from hypogoal.data import open_dataset
from hypogoal.importing.pictures import picture_of, read_pictures
from tests.importing.robot_data import write_film
from tests.importing.states import SIDE, pictures, save_pictures
from tests.importing.test_odd import stored


def test_what_is_no_picture_of_a_state_is_one_line(tmp_path: Path) -> None:
    """Spec G2: the file is named, and PostScript is not even opened: Pillow would run a program."""
    folder = save_pictures(tmp_path / "images")
    file = folder / "positive" / "zz.png"
    palette = io.BytesIO()
    Image.new("P", (SIDE, SIDE), 1).save(palette, "GIF", transparency=1)
    for data, said in (
        (stored(np.zeros((SIDE, 20, 3), np.uint8)), "states differ in size or type: positive/zz.png[0] is (48, 20, 3)"),
        (b"no image", "it is none of PNG, JPEG,"),
        (stored(pictures(1)[0][0])[:200], "this cannot be read"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n", "this cannot be read"),
        (palette.getvalue(), "it is transparent in places"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n", "git lfs pull"),
    ):
        file.write_bytes(data)
        line = refuses(said, "import", folder, "--out", tmp_path / "data.h5")
        assert "zz.png" in line
    for other in (file, *(folder / "unlabelled").iterdir()):
        other.unlink()
    refuses("there are no unlabelled states", "import", folder, "--out", tmp_path / "data.h5")


def test_folders_of_pictures_become_states(tmp_path: Path) -> None:
    """Spec B6: the folder's name is the sub-goal's; grey pictures have one channel, unless others are coloured."""
    data = tmp_path / "data.h5"
    folder = save_pictures(tmp_path / "at-right")
    run("import", folder, "--out", data, "-q")
    found = open_dataset(data)
    assert found.sub_goals == ("at-right",)
    images, labels = pictures(24)
    np.testing.assert_array_equal(found.labelled("at-right").observations[:12], images[labels])
    assert found.counts()["heldout"]["at-right"] == {"states": 6, "positives": 3}
    grey = save_pictures(tmp_path / "grey", change=lambda image: image[..., 0])
    run("import", grey, "--out", data, "-q", "--force")
    assert open_dataset(data).observation_shape == (SIDE, SIDE, 1)
    (grey / "positive" / "01.png").write_bytes(stored(images[1]))
    run("import", grey, "--out", data, "-q", "--force")
    mixed = open_dataset(data).labelled("grey").observations
    np.testing.assert_array_equal(mixed[0], images[1])
    np.testing.assert_array_equal(mixed[1], images[3][..., :1].repeat(3, 2))


def test_what_is_not_read_is_counted_and_folders_are_groups(tmp_path: Path) -> None:
    """Spec B3, B6: by suffix; links are followed; a folder within a kind is held out whole or not at all."""
    folder = save_pictures(tmp_path / "goal", held=False)
    for kind in ("positive", "negative", "unlabelled"):
        for number, file in enumerate(sorted((folder / kind).iterdir())):
            day = folder / kind / f"day{number % 4}"
            day.mkdir(exist_ok=True)
            file.rename(day / file.name.replace(".png", ".PNG"))
        (folder / kind / "x.heic").write_bytes(b"x")
        (folder / kind / ".hidden").write_bytes(b"x")
    (folder / "positive" / "day1").rename(tmp_path / "elsewhere")
    (folder / "positive" / "day1").symlink_to(tmp_path / "elsewhere")
    said = run("import", folder, "--out", tmp_path / "data.h5", "--heldout", "0.3", "-q").err
    assert "not read: 3 .heic\n" in said
    found = open_dataset(tmp_path / "data.h5")
    left: Counter[str] = Counter()
    episodes = [each for each in read_pictures(folder, "goal", left) if each.role == "labelled"]
    assert left == Counter({".heic": 3}) and len(episodes) == 24
    day = {}
    for each in episodes:
        path = folder / each.name
        day[picture_of(path.read_bytes(), path).tobytes()] = each.group
    held = {day[state.tobytes()] for state in found.heldout("goal").observations}
    learned = {day[state.tobytes()] for state in found.labelled("goal").observations}
    assert len(held) == 1 and held | learned == {f"day{number}" for number in range(4)} and not held & learned
    others = {day.get(state.tobytes()) for state in found.unlabelled()}
    assert not others & held


def test_each_picture_is_read_once_and_none_that_a_system_keeps(tmp_path: Path) -> None:
    """Spec B6: links in a circle, thumbnails; a picture with both labels is told."""
    folder = save_pictures(tmp_path / "goal")
    words = ["import", folder, "--resize", "24", "-q", "--out"]
    run(*words, tmp_path / "plain.h5")
    for kind in ("positive", "negative", "unlabelled"):
        (folder / kind / "again").symlink_to(".")
        (folder / kind / "up").symlink_to("..")
        (folder / kind / "elsewhere" / "deep").mkdir(parents=True)
        (folder / kind / "elsewhere" / "deep" / "back").symlink_to(folder / kind / "elsewhere")
        for name in ("@eaDir", "Thumbnails"):
            (folder / kind / name).mkdir()
            for file in (folder / kind).glob("*.png"):
                Image.open(file).resize((30, 30)).save(folder / kind / name / file.name)
    said = run(*words, tmp_path / "odd.h5").err
    assert (
        "not read: 3 folders '@eaDir', 3 folders 'Thumbnails', 3 folders 'again', 3 folders 'back', 3 folders 'up'"
        in said
    )
    counts = open_dataset(tmp_path / "odd.h5").counts()
    assert counts == open_dataset(tmp_path / "plain.h5").counts()
    (folder / "negative" / "copy.png").write_bytes((folder / "positive" / "01.png").read_bytes())
    said = run(*words, tmp_path / "both.h5").err
    assert "no member can be right about negative/copy.png[0] and positive/01.png[0]" in said


def test_what_is_there_instead_of_pictures_is_named(tmp_path: Path) -> None:
    folder = save_pictures(tmp_path / "goal")
    for file in [*folder.rglob("*.png")]:
        file.rename(file.with_suffix(".HEIC"))
    refuses("Here are .heic: pictures belong as PNG", "import", folder, "--out", tmp_path / "x.h5")
    for file in [*folder.rglob("*.HEIC")]:
        file.rename(file.with_suffix(".png"))
    (folder / "positive").rename(folder / "yes")
    refuses(
        "Here are .png: pictures belong as PNG or JPEG into positive/", "import", folder, "--out", tmp_path / "x.h5"
    )


def test_films_of_one_name_are_told_apart_by_no_label(tmp_path: Path) -> None:
    """Spec I6: x.mkv beside x.mp4 would be one episode, of both."""
    for name in ("a.mp4", "a.mkv", "b.mp4"):
        write_film(tmp_path / "takes" / name, [*pictures(4)[0]])
    words = ["import", tmp_path / "takes", "--label", "on=last:1", "--out", tmp_path / "x.h5"]
    refuses("two episodes have one name: a. Rename one", *words)


def test_large_pictures_are_made_smaller(tmp_path: Path) -> None:
    """Spec B6: their longer side has so many pixels, areas are averaged; what is small enough stays as it is."""
    images, labels = pictures(24)
    small = images.reshape(24, 24, 2, 24, 2, 3).mean((2, 4))
    folder, out = save_pictures(tmp_path / "at-right"), tmp_path / "data.h5"
    run("import", folder, "--out", out, "--resize", "24", "-q")
    data = open_dataset(out)
    assert data.observation_shape == (24, 24, 3) and data.config["resize"] == 24
    assert np.abs(data.labelled("at-right").observations[:12] - small[labels]).max() <= 1
    large = folder / "positive" / "01.png"
    Image.open(large).resize((96, 96)).save(large)
    refuses("states differ in size", "import", folder, "--out", tmp_path / "x.h5")
    run("import", folder, "--out", out, "--resize", "30", "-q", "--force")
    assert open_dataset(out).observation_shape == (30, 30, 3)
