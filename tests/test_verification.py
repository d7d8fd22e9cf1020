"""Is it whole: what ``verify`` finds in artefacts that the stages made (Spec A8, G2)."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_data import files_of, reseal

import hypogoal
from hypogoal.cli import main
from hypogoal.core.artefacts import find_artefacts, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.manifests import MANIFEST, read_manifest
from hypogoal.inspection import faults_of, notes_of
from hypogoal.stages.train_ensemble import unlabelled_file

TESTS = Path(__file__).parent
FEW = ["--set", "environments=4", "--set", "warm_up=50", "--set", "steps=400", "-q"]
KINDS = ("ensemble", "options", "meta", "baseline", "evaluation", "report", "comparison", "audit")
# What settings do not say.
MAY = {"executions.csv", "exploits.csv"}, ("figures/", "videos/", "before-", "mended-")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of every stage on the toy domain, the learning ones in each setting that changes which files there are."""
    run = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TESTS))
        patch.setenv("HYPOGOAL_TRUST", "own_domain:DOMAIN,own_domain:ODD")

        def made(*words: object) -> None:
            assert main([str(word) for word in words]) == 0, words

        made("collect", "own_domain:DOMAIN", "--out", run / "data.h5", "--set", "copies=9", "-q")
        small = ("--set", "steps=30", "--set", "workers=1", "-q")
        made("train-ensemble", run / "data.h5", "--out", run / "ensemble", *small)
        more = ("--set", "initiation=learned", "--set", "save_visited=20")
        for name, settings in (("options", ()), ("options-more", more)):
            made("train-options", run / "ensemble", "--out", run / name, *settings, *FEW)
        for name, settings in (("meta", ()), ("meta-more", more), ("random", ("--set", "chooser=random"))):
            made("train-meta", run / "ensemble", "--out", run / name, *settings, *FEW)
        played = ("--set", "steps=128", "--set", "max_episode_steps=20", "-q")
        made("train-baseline", "own_domain:ODD", "--out", run / "ppo", *played)
        where = ("--domain", "own_domain:DOMAIN", "--sub-goal", "left-end", "--set", "restart_options=false")
        made("audit", run / "ensemble", "--out", run / "audit", *where, *FEW)
        made("evaluate", run, "-q")
        made("report", run)
        shutil.copytree(run, run.with_name("other"))
        made("compare", run, run.with_name("other"), "--out", run / "comparison")
    return run


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "run")


def test_each_kind_has_the_files_that_its_stage_writes(run: Path) -> None:
    """Spec A8: each stage writes all its files and lists them in the manifest, in every setting."""
    seen = set()
    for kind in KINDS:
        for artefact in find_artefacts(run, kind):
            wanted = files_of(kind, artefact.config)
            more = artefact.manifest["files"].keys() - wanted
            assert wanted <= artefact.manifest["files"].keys()
            assert all(name in MAY[0] or name.startswith(MAY[1]) for name in more), more
            seen.add((kind, frozenset(wanted)))
    assert {kind for kind, _ in seen} == {*KINDS} and len(seen) == len(KINDS) + 1 + 2
    assert faults_of(run) == []


def test_every_file_that_is_gone_is_named(copy: Path) -> None:
    """Spec A8, G2: the manifest lists it; stages refuse the artefact, too."""
    count = 0
    for kind in KINDS:
        artefact = find_artefacts(copy, kind)[0]
        for name in sorted(files_of(kind, artefact.config)):
            (artefact.path / name).rename(copy / "aside")
            line = f"{artefact.path}: {name}: missing"
            assert faults_of(artefact.path) == [line]
            with pytest.raises(UserError, match="the artefact is damaged"):
                open_artefact(artefact.path).whole()
            (copy / "aside").rename(artefact.path / name)
            count += 1
    assert count == 34 and faults_of(copy) == []
    (copy / "ensemble" / "left-end.safetensors").unlink()
    with pytest.raises(UserError, match=r"the artefact is damaged \(left-end\.safetensors: missing"):
        hypogoal.load_ensemble(copy / "ensemble", "right-end")
    reseal(copy / "ensemble", files={})  # a forger's manifest, silent about it
    assert "left-end.safetensors" in faults_of(copy / "ensemble")[0]
    with pytest.raises(UserError, match="the weights are missing"):
        hypogoal.load_ensemble(copy / "ensemble", "left-end")


def test_what_is_no_part_of_an_artefact_is_mentioned(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A8: no fault, since nothing reads it; not even where a file of that name would be read."""
    ensemble = copy / "ensemble"
    (ensemble / "notes").mkdir()
    (ensemble / "notes" / "mine.txt").write_text("x")
    (ensemble / ".hidden").write_text("x")
    (ensemble / "away").symlink_to("/")
    shutil.copytree(copy / "ppo", ensemble / "inner")  # an artefact of its own
    (ensemble / ".meta.partial").mkdir()
    (ensemble / ".meta.partial" / "lock").touch()
    extra = [note.removeprefix(f"{ensemble}: ") for note in notes_of(ensemble)][:-1]
    assert extra == [f"{name}: not a part of it" for name in (".hidden", "away", "notes/mine.txt")]
    assert main(["verify", str(ensemble)]) == 0
    assert "notes/mine.txt: not a part of it" in capsys.readouterr().out
    shutil.copy(copy / "options-more" / "visited.h5", copy / "options" / "visited.h5")
    with pytest.raises(UserError, match="no visited states"):
        unlabelled_file(copy / "options", None)


def test_every_changed_bit_of_a_manifest_is_found(copy: Path) -> None:
    """Spec A8, G2: a bit of each byte in one of them, and some bytes replaced, taken out or put in."""
    path = copy / "ppo" / MANIFEST
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    bits = rng.integers(0, 8, len(whole)).tolist()
    changed = [whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :] for at, bit in enumerate(bits)]
    for place, value in zip(
        rng.integers(0, len(whole), 1000).tolist(), rng.integers(1, 256, 1000).tolist(), strict=True
    ):
        changed.append(whole[:place] + bytes([whole[place] ^ value]) + whole[place + 1 :])
    spaces = (b"", b" ", b"\n", b"\r", b"\xef\xbb\xbf", b"\0")
    changed += [
        whole[:place] + more + whole[place + (not more) :] for place in range(0, len(whole), 7) for more in spaces
    ]
    changed += [
        whole.replace(b"\n", b"\r\n"),
        whole[:-1],
        whole + b"\n",
        b"\xef\xbb\xbf" + whole,
        json.dumps(json.loads(whole)).encode(),
    ]
    missed = []
    for data in changed:
        path.write_bytes(data)
        try:
            read_manifest(path)
        except UserError:
            continue
        missed.append(data)
    assert missed == [] and len(changed) > 3000


def test_messages_about_manifests_stay_helpful(copy: Path) -> None:
    """Spec G2: what is newer is not called damaged, nor is what an earlier hypogoal wrote."""
    path = copy / "meta" / MANIFEST
    manifest = json.loads(path.read_text())
    for change, words in (
        ({"format": 3}, "newer"),
        ({"seed": -1}, "checksum does not match"),
        ({"format": 1}, "checksum"),
    ):
        path.write_text(json.dumps(manifest | change, indent=1) + "\n")
        with pytest.raises(UserError, match=words):
            read_manifest(path)
    reseal(path.parent, seed=-1)
    with pytest.raises(UserError, match="'seed' is missing or malformed"):
        read_manifest(path)
    del manifest["sha256"]
    path.write_text(json.dumps(manifest | {"format": 1}))  # as they were before
    assert faults_of(path.parent) == []
    assert notes_of(path.parent)[0].endswith("written by an earlier hypogoal, its manifest has no checksum")


def test_an_evaluation_of_before_is_whole(copy: Path) -> None:
    """Spec A8: an earlier hypogoal wrote no numbers.csv; its report can still be drawn."""
    path = copy / "evaluation" / MANIFEST
    manifest = json.loads(path.read_text())
    (path.parent / "numbers.csv").unlink()
    files = {name: digest for name, digest in manifest.pop("files").items() if name != "numbers.csv"}
    del manifest["sha256"]
    path.write_text(json.dumps(manifest | {"format": 1, "files": files}))
    assert faults_of(path.parent) == []
    assert main(["report", str(copy), "--force"]) == 0


def test_verify_looks_inside_the_folder_only(run: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A8: of a copied run an input that is gone is gone, though it still is where it was once."""
    assert faults_of(copy) == []
    outside = [note for note in notes_of(copy) if "outside" in note]
    assert outside == [
        f"{copy}/comparison: its input {run.with_name('other')}/evaluation (evaluation) lies outside, not checked"
    ]
    shutil.rmtree(copy / "ensemble")
    gone = [fault for fault in faults_of(copy) if f"its input {run}/ensemble (ensemble) is gone" in fault]
    assert len(gone) == 7  # options, metas, the audit, and the evaluation
    assert open_artefact(copy / "meta").input("ensemble") == run / "ensemble"  # to a stage it is not
    assert main(["verify", str(copy / "meta"), "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about["faults"] == [] and "lies outside, not checked" in about["notes"][0]
    (copy / "ensemble").symlink_to(run / "ensemble")  # which leads outside
    assert faults_of(copy) == [] and sum("/ensemble (ensemble) lies outside" in note for note in notes_of(copy)) == 7
    for relative in ("/", "../../..", "loop"):
        entry = {**open_artefact(copy / "meta").manifest["inputs"][0], "relative": relative}
        os.symlink("loop", copy / "meta" / "loop") if relative == "loop" else None
        reseal(copy / "meta", inputs=[entry])
        assert faults_of(copy / "meta") == [] and "lies outside" in notes_of(copy / "meta")[-1]
