"""Is it whole: what ``verify`` finds in artefacts that the stages made (Spec A8, G2)."""

import json
import os
import shutil
from pathlib import Path

import pytest
from command_line import run
from toy_data import files_of, reseal

import hypogoal
from hypogoal.core.artefacts import Artefact, find_artefacts, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.inspection import faults_of, notes_of

KINDS = ("ensemble", "options", "meta", "baseline", "evaluation", "report", "comparison", "audit")
# What settings do not say.
MAY = {"executions.csv", "exploits.csv"}, ("figures/", "videos/", "before-", "mended-")


def test_each_kind_has_the_files_that_its_stage_writes(corridor_run: Path) -> None:
    """Spec A8: each stage writes all its files and lists them in the manifest, in every setting."""
    seen = set()
    for kind in KINDS:
        for artefact in find_artefacts(corridor_run, kind):
            wanted = files_of(kind, artefact.config)
            more = artefact.manifest.files.keys() - wanted
            assert wanted <= artefact.manifest.files.keys()
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
                open_artefact(artefact.path)
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


def test_what_was_made_with_settings_that_are_gone_is_refused(corridor_copy: Path) -> None:
    """Not read as if it had been made without them; their old defaults changed nothing."""
    folder = corridor_copy / "meta"
    config = Artefact(folder).config
    reseal(folder, config={**config, "initiation": "anywhere"})
    Artefact(folder)
    reseal(folder, config={**config, "initiation": "learned"})
    with pytest.raises(UserError, match=r"made with initiation=learned.*Make the artefact again"):
        Artefact(folder)
    reseal(folder, config={**config, "domain_config": {"keyring": False}})
    with pytest.raises(UserError, match="made with keyring=False"):
        Artefact(folder)


def test_verify_looks_inside_the_folder_only(corridor_run: Path, corridor_copy: Path) -> None:
    """Spec A8: of a copied run an input that is gone is gone, though it still is where it was once."""
    run_there, here = corridor_run, corridor_copy
    other = corridor_run.with_name("corridor-other")
    assert faults_of(here) == []
    assert [note for note in notes_of(here) if "outside" in note] == [
        f"{here}/comparison: its input {other}/evaluation (evaluation) lies outside, not checked"
    ]
    shutil.rmtree(here / "ensemble")
    gone = [fault for fault in faults_of(here) if f"its input {run_there}/ensemble (ensemble) is missing" in fault]
    assert len(gone) == 9  # options, metas, the audit, and the evaluation
    meta = here / "meta"
    assert open_artefact(meta).input("ensemble") == run_there / "ensemble"  # to a stage it is not
    about = json.loads(run("verify", meta, "--json").out)
    assert about["faults"] == [] and "lies outside, not checked" in about["notes"][0]
    (here / "ensemble").symlink_to(run_there / "ensemble")  # which leads outside
    assert faults_of(here) == []
    assert sum("/ensemble (ensemble) lies outside" in note for note in notes_of(here)) == 9
    for relative in ("/", "../../..", "loop"):
        entry = {**Artefact(meta).manifest.inputs[0].model_dump(), "relative": relative}
        if relative == "loop":
            os.symlink("loop", meta / "loop")
        reseal(meta, inputs=[entry])
        assert faults_of(meta) == [] and "lies outside" in notes_of(meta)[-1]
