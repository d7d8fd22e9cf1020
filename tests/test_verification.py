"""Is it whole: what ``verify`` finds in artefacts that the stages made (Spec A8, G2)."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from toy_data import files_of, reseal

import hypogoal
from hypogoal.core.artefacts import find_artefacts, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.manifests import MANIFEST, read_manifest
from hypogoal.inspection import faults_of, notes_of
from hypogoal.stages.train_ensemble import unlabelled_file

KINDS = ("ensemble", "options", "meta", "baseline", "evaluation", "report", "comparison", "audit")
# What settings do not say.
MAY = {"executions.csv", "exploits.csv"}, ("figures/", "videos/", "before-", "mended-")


def test_each_kind_has_the_files_that_its_stage_writes(corridor_run: Path) -> None:
    """Spec A8: each stage writes all its files and lists them in the manifest, in every setting."""
    seen = set()
    for kind in KINDS:
        for artefact in find_artefacts(corridor_run, kind):
            wanted = files_of(kind, artefact.config)
            more = artefact.manifest["files"].keys() - wanted
            assert wanted <= artefact.manifest["files"].keys()
            assert all(name in MAY[0] or name.startswith(MAY[1]) for name in more), more
            seen.add((kind, frozenset(wanted)))
    assert {kind for kind, _ in seen} == {*KINDS} and len(seen) == len(KINDS) + 1 + 2
    assert faults_of(corridor_run) == []


def test_every_file_that_is_gone_is_named(corridor_copy: Path) -> None:
    """Spec A8, G2: the manifest lists it; stages refuse the artefact, too."""
    count = 0
    for kind in KINDS:
        artefact = find_artefacts(corridor_copy, kind)[0]
        for name in sorted(files_of(kind, artefact.config)):
            (artefact.path / name).rename(corridor_copy / "aside")
            line = f"{artefact.path}: {name}: missing"
            assert faults_of(artefact.path) == [line]
            with pytest.raises(UserError, match="the artefact is damaged"):
                open_artefact(artefact.path).whole()
            (corridor_copy / "aside").rename(artefact.path / name)
            count += 1
    assert count == 34 and faults_of(corridor_copy) == []
    (corridor_copy / "ensemble" / "left-end.safetensors").unlink()
    with pytest.raises(UserError, match=r"the artefact is damaged \(left-end\.safetensors: missing"):
        hypogoal.load_ensemble(corridor_copy / "ensemble", "right-end")
    reseal(corridor_copy / "ensemble", files={})  # a forger's manifest, silent about it
    assert "left-end.safetensors" in faults_of(corridor_copy / "ensemble")[0]
    with pytest.raises(UserError, match="the weights are missing"):
        hypogoal.load_ensemble(corridor_copy / "ensemble", "left-end")


def test_what_is_no_part_of_an_artefact_is_mentioned(corridor_copy: Path) -> None:
    """Spec A8: no fault, since nothing reads it; not even where a file of that name would be read."""
    ensemble = corridor_copy / "ensemble"
    (ensemble / "notes").mkdir()
    (ensemble / "notes" / "mine.txt").write_text("x")
    (ensemble / ".hidden").write_text("x")
    (ensemble / "away").symlink_to("/")
    shutil.copytree(corridor_copy / "ppo", ensemble / "inner")  # an artefact of its own
    (ensemble / ".meta.partial").mkdir()
    (ensemble / ".meta.partial" / "lock").touch()
    extra = [note.removeprefix(f"{ensemble}: ") for note in notes_of(ensemble)][:-1]
    assert extra == [f"{name}: not a part of it" for name in (".hidden", "away", "notes/mine.txt")]
    assert "notes/mine.txt: not a part of it" in run("verify", ensemble).out
    shutil.copy(corridor_copy / "options-more" / "visited.h5", corridor_copy / "options" / "visited.h5")
    with pytest.raises(UserError, match="no visited states"):
        unlabelled_file(corridor_copy / "options", None)


def test_every_changed_bit_of_a_manifest_is_found(corridor_copy: Path) -> None:
    """Spec A8, G2: a bit of each byte in one of them, and some bytes replaced, taken out or put in."""
    path = corridor_copy / "ppo" / MANIFEST
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


def test_messages_about_manifests_stay_helpful(corridor_copy: Path) -> None:
    """Spec G2: what is newer or older is not called damaged."""
    path = corridor_copy / "meta" / MANIFEST
    manifest = json.loads(path.read_text())
    for change, words in (
        ({"format": 3}, "newer"),
        ({"format": 1}, "of an earlier hypogoal.*Make the artefact again"),
        ({"seed": -1}, "checksum does not match"),
    ):
        path.write_text(json.dumps(manifest | change, indent=1) + "\n")
        with pytest.raises(UserError, match=words):
            read_manifest(path)
    reseal(path.parent, seed=-1)
    with pytest.raises(UserError, match="'seed' is missing or malformed"):
        read_manifest(path)


def test_what_was_made_with_settings_that_are_gone_is_refused(corridor_copy: Path) -> None:
    """Not read as if it had been made without them; their old defaults changed nothing."""
    folder = corridor_copy / "meta"
    config = read_manifest(folder / MANIFEST)["config"]
    reseal(folder, config={**config, "initiation": "anywhere"})
    read_manifest(folder / MANIFEST)
    reseal(folder, config={**config, "initiation": "learned"})
    with pytest.raises(UserError, match=r"made with initiation=learned.*Make the artefact again"):
        read_manifest(folder / MANIFEST)
    reseal(folder, config={**config, "domain_config": {"keyring": False}})
    with pytest.raises(UserError, match="made with keyring=False"):
        read_manifest(folder / MANIFEST)


def test_verify_looks_inside_the_folder_only(corridor_run: Path, corridor_copy: Path) -> None:
    """Spec A8: of a copied run an input that is gone is gone, though it still is where it was once."""
    run_there, here = corridor_run, corridor_copy
    other = corridor_run.with_name("corridor-other")
    assert faults_of(here) == []
    assert [note for note in notes_of(here) if "outside" in note] == [
        f"{here}/comparison: its input {other}/evaluation (evaluation) lies outside, not checked"
    ]
    shutil.rmtree(here / "ensemble")
    gone = [fault for fault in faults_of(here) if f"its input {run_there}/ensemble (ensemble) is gone" in fault]
    assert len(gone) == 9  # options, metas, the audit, and the evaluation
    meta = here / "meta"
    assert open_artefact(meta).input("ensemble") == run_there / "ensemble"  # to a stage it is not
    about = json.loads(run("verify", meta, "--json").out)
    assert about["faults"] == [] and "lies outside, not checked" in about["notes"][0]
    (here / "ensemble").symlink_to(run_there / "ensemble")  # which leads outside
    assert faults_of(here) == []
    assert sum("/ensemble (ensemble) lies outside" in note for note in notes_of(here)) == 9
    for relative in ("/", "../../..", "loop"):
        entry = {**open_artefact(meta).manifest["inputs"][0], "relative": relative}
        if relative == "loop":
            os.symlink("loop", meta / "loop")
        reseal(meta, inputs=[entry])
        assert faults_of(meta) == [] and "lies outside" in notes_of(meta)[-1]
