"""Artefacts: complete or absent, and refused when they are not what is needed (Spec A8, G2)."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from toy_data import files_of, reseal

from hypogoal.core.artefacts import check_files, claim, create_artefact, find_artefacts, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for, seed_for, torch_generator
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.data import create_hdf5


def make(out: Path, kind: str = "meta", inputs: tuple[Path, ...] = (), force: bool = False) -> Path:
    with create_artefact(out, kind=kind, config={"steps": 3}, seed=7, inputs=inputs, force=force) as folder:
        for name in files_of(kind, {}):
            (folder / name).write_text("step\n1\n")
    return out


def test_a_manifest_says_what_made_it(tmp_path: Path) -> None:
    """Spec A8: kind, format, configuration, seed, hashes of files and of inputs, versions."""
    first = make(tmp_path / "ensemble", "ensemble")
    artefact = open_artefact(make(tmp_path / "meta", inputs=(first,)), "meta")
    assert artefact.config == {"steps": 3} and artefact.seed == 7
    assert artefact.input("ensemble") == first.resolve()
    assert set(artefact.manifest["files"]) == files_of("meta", {})
    assert {"python", "torch", "numpy"} <= set(artefact.manifest["versions"])
    assert check_files(artefact) == []


def break_off(out: Path) -> None:
    """A stage that fails half-way."""
    with create_artefact(out, kind="meta", config={}, seed=0, force=True) as folder:
        (folder / "half").write_text("x")
        raise RuntimeError("broke")


def test_a_failed_stage_leaves_nothing(tmp_path: Path) -> None:
    """Spec G2: no half-written output, and what stood there before stands there still."""
    out = make(tmp_path / "meta")
    with pytest.raises(RuntimeError, match="broke"):
        break_off(out)
    assert [path.name for path in tmp_path.iterdir()] == ["meta"]
    assert open_artefact(out).config == {"steps": 3}


def test_moved_runs_find_their_inputs(tmp_path: Path) -> None:
    """Spec A8: inputs are found beside the artefact when the run was moved as a whole."""
    (tmp_path / "run").mkdir()
    first = make(tmp_path / "run" / "ensemble", "ensemble")
    make(tmp_path / "run" / "meta", inputs=(first,))
    (tmp_path / "run").rename(tmp_path / "moved")
    assert open_artefact(tmp_path / "moved" / "meta").input("ensemble") == (tmp_path / "moved" / "ensemble").resolve()


def test_refusals(tmp_path: Path) -> None:
    """Spec G2: each says what, where and what to do, in one line."""
    out = make(tmp_path / "meta")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").write_text("precious")
    cases = [
        (lambda: claim(out, kind="meta"), "exists already"),
        (lambda: claim(tmp_path / "other", kind="meta", force=True), "without a manifest"),
        (lambda: open_artefact(tmp_path / "none"), "no such artefact"),
        (lambda: open_artefact(tmp_path / "other"), "not an artefact"),
        (lambda: open_artefact(out, "ensemble"), "'ensemble' is needed|but ensemble is needed"),
        (lambda: find_artefacts(tmp_path / "none", "meta"), "no such run"),
    ]
    for case, words in cases:
        with pytest.raises(UserError, match=words) as caught:
            case()
        assert "\n" not in str(caught.value)
    assert (tmp_path / "other" / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 1 << 53}, "'seed'"),
        ({"seed": -1}, "'seed'"),
        ({"config": {"sub_goals": ["a", "a"]}}, "'sub_goals'"),
        ({"config": {"layout_seed": (1 << 53) + 1}}, "'layout_seed'"),
        ({"config": {"threshold": float("nan")}}, "not valid JSON"),
        ({"inputs": [b"\xff.h5"]}, "not valid JSON"),
    ],
)
def test_what_could_not_be_read_again_is_not_begun(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    """Spec A8, G2: a manifest is refused before the work for it, not by the next stage."""
    out = tmp_path / "meta"
    about: dict[str, Any] = {"kind": "meta", "config": {"steps": 3}, "seed": 0, **change}
    about["inputs"] = [tmp_path / os.fsdecode(name) for name in about.get("inputs", ())]
    for path in about["inputs"]:
        path.write_text("states")
    with pytest.raises(UserError, match=words) as caught, create_artefact(out, **about):
        raise AssertionError("it worked")
    assert "could not be read again" in str(caught.value) and not out.exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_force_replaces_only_what_a_stage_makes_there(tmp_path: Path) -> None:
    """Spec A6, G2: nothing of another kind and no file of others', however wrong the --out."""
    ensemble, meta = make(tmp_path / "ensemble", "ensemble"), make(tmp_path / "meta")
    unreadable = make(tmp_path / "unreadable")
    (unreadable / "manifest.json").write_text("{")
    (tmp_path / "empty").mkdir()
    texts = {"thesis.txt": b"precious", "foreign.h5": b"precious", "foreign.npz": b"precious"}
    for name, text in texts.items():
        (tmp_path / name).write_bytes(text)
    with create_hdf5(tmp_path / "other.h5") as file:
        file["weights"] = [1.0]
    cut = tmp_path / "cut.h5"  # another's
    cut.write_bytes((tmp_path / "other.h5").read_bytes()[:1000])
    before = contents(tmp_path)
    cases = [
        (ensemble, "meta"),
        (cut, "data"),
        (unreadable, "meta"),
        (ensemble, "data"),
        (tmp_path / "other.h5", "data"),
    ]
    cases += [(tmp_path / name, kind) for name in texts for kind in ("meta", "data", "arrays")]
    for out, kind in cases:
        with pytest.raises(UserError, match="the existing output is not of kind"):
            claim(out, kind=kind, force=True)
    assert contents(tmp_path) == before
    (meta / "manifest.json").write_text('{"format": 1, "kind": "meta"}')  # damaged, and to be made again
    for out in (meta, tmp_path / "empty"):
        make(out, force=True)
        assert check_files(open_artefact(out, "meta")) == []


def test_force_never_replaces_an_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: whatever it is called, and whatever lies in it."""
    monkeypatch.chdir(tmp_path)
    run = make(tmp_path / "run", "ensemble")
    inner, beside = make(run / "inner", "options"), tmp_path / "link"
    beside.symlink_to(run)
    before = contents(tmp_path)
    for out, path in ((run, run), (Path("run"), run), (beside, run), (run, beside), (run, inner), (Path("."), inner)):
        with pytest.raises(UserError, match="would replace an input"):
            make(out, "ensemble", inputs=(path,), force=True)
    assert contents(tmp_path) == before
    assert make(inner, "options", inputs=(run,), force=True) == inner


def test_changed_missing_and_foreign_files_are_found(tmp_path: Path) -> None:
    """Spec G2: hashes are checked, and a manifest cannot point outside its folder."""
    out = make(tmp_path / "meta")
    (out / "episodes.csv").write_text("changed")
    assert check_files(open_artefact(out)) == ["episodes.csv: changed since it was written"]
    (out / "episodes.csv").unlink()
    assert check_files(open_artefact(out)) == ["episodes.csv: missing"]
    reseal(out, files={"../../etc/passwd": "0"})
    assert check_files(open_artefact(out))[-1] == "../../etc/passwd: outside the artefact"


def test_damaged_weights(tmp_path: Path) -> None:
    """Spec G2: a truncated safetensors file is one clear line."""
    path = tmp_path / "weights.safetensors"
    save_tensors(path, {"a": torch.arange(100.0)})
    torch.testing.assert_close(load_tensors(path)["a"], torch.arange(100.0))
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(UserError, match="damaged"):
        load_tensors(path)
    with pytest.raises(UserError, match="missing"):
        load_tensors(tmp_path / "none")


def test_streams_are_named_and_reproducible() -> None:
    """Randomness is passed in: same seed and name, same stream; another name, another stream."""
    assert seed_for(1, "a", 2) == seed_for(1, "a", 2) != seed_for(1, "a", 3)
    np.testing.assert_array_equal(rng_for(1, "a").random(3), rng_for(1, "a").random(3))
    assert rng_for(1, "a").random() != rng_for(1, "b").random()
    assert torch.equal(
        torch.rand(3, generator=torch_generator(1, "a")), torch.rand(3, generator=torch_generator(1, "a"))
    )


def test_claim_makes_nothing_and_finds_a_file_in_the_way(tmp_path: Path) -> None:
    """Spec G2."""
    assert claim(tmp_path / "a" / "b" / "c", kind="meta") == tmp_path / "a" / "b" / "c"
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("x")
    for name, words in (("file/out", "in the way"), (f"{'x' * 240}.h5", "longer than 200 bytes")):
        with pytest.raises(UserError, match=words):
            claim(tmp_path / name, kind="data")


def test_what_a_stage_took_is_in_its_manifest_and_changes_nothing_else(tmp_path: Path) -> None:
    """Spec A8: seconds and bytes of memory, of which inputs know nothing: an input made again is the same input."""
    source, made = make(tmp_path / "ensemble", "ensemble"), tmp_path / "meta"
    with create_artefact(made, kind="meta", config={}, seed=0, inputs=[source]):
        time.sleep(0.11)
    took = open_artefact(made).manifest["took"]
    assert 0.1 <= took["seconds"] < 60 and 1e7 < took["memory"] < 1e12
    reseal(source, took={"seconds": 9.9, "memory": 9})
    assert open_artefact(made).input("ensemble") == source.resolve()
    reseal(source, seed=9)
    with pytest.raises(UserError, match="changed since"):
        open_artefact(made).input("ensemble")
