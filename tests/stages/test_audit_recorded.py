"""An audit of recorded data, labels for what it proposes, and their way back into the data (Spec I6)."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch
from command_line import refuses, run, settings
from numpy.typing import NDArray
from torch import nn

from hypogoal.cli import main
from hypogoal.core.artefacts import TO_FILL_IN, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, open_dataset, write_dataset
from hypogoal.evaluation.page import lines_of
from hypogoal.evaluation.pictures import picture_of
from hypogoal.hypotheses.labelling import density_of, disagreement, sketches_of, to_label
from hypogoal.importing.labels import read_table
from hypogoal.observations import digest, packed
from hypogoal.tools.audit_recorded import member_table
from hypogoal.tools.classifiers import OwnClassifier
from tests import mixed
from tests.mixed import GOAL


def test_an_audit_of_recorded_data(mixed_run: Path) -> None:
    """Numbers, the table and the page; the rows are states of the file, each once, disputed ones first."""
    audit, data = mixed_run / "audit", open_dataset(mixed_run / "data.h5")
    artefact = open_artefact(audit, "recorded-audit")
    pictures = {f"next/{GOAL}/{number:03d}.png" for number in range(1, 21)}
    assert artefact.manifest.files.keys() == {"audit.json", "index.html", *pictures}
    [part] = json.loads((audit / "audit.json").read_text())["sub_goals"]
    assert (part["sub_goal"], part["known"], part["unlabelled"], len(part["members"])) == (GOAL, 56, 20, 2)
    rows = read_table(audit / "next" / GOAL / TO_FILL_IN, {"row": int, "digest": str})
    places = rows["row"].tolist()
    assert sorted(places) == list(range(20)) and places == part["next"]
    assert [digest(data.unlabelled()[place]).hex() for place in places] == rows["digest"].tolist()
    page = (audit / "index.html").read_text()
    assert "To label next" in page and page.count("data:image/webp") >= 20
    assert "Content-Security-Policy" in page and "http" not in page.replace("http-equiv", "")


def often(observations: Any) -> NDArray[np.float64]:
    """A success check in code."""
    return (observations["state"].mean(axis=1) > 0).astype(np.float64)


def certain(observations: Any) -> NDArray[np.float64]:
    """A success everywhere."""
    return np.ones(len(observations))


def test_a_function_is_audited_on_labels_by_hand(mixed_run: Path, tmp_path: Path, capsys: Any) -> None:
    """Its share of known failures is that of the data; a larger one than allowed is exit code 3, and one JSON line."""
    data = open_dataset(mixed_run / "data.h5")
    splits = data.labelled(GOAL), data.heldout(GOAL)
    failures = [often(split.observations[~split.labels]) for split in splits]
    share = float(np.concatenate(failures).mean())
    assert 0.1 < share < 0.9
    words = ["audit", f"{__name__}:often", "--data", str(mixed_run / "data.h5"), "--json"]
    capsys.readouterr()
    for number, (limit, code) in enumerate(((share - 0.01, 3), (share + 0.01, 0))):
        out = tmp_path / str(number)
        assert main([*words, "--fail-above", str(limit), "--out", str(out)]) == code
        told = json.loads(capsys.readouterr().out)
        assert told == {
            "out": str(out), "false_positives": {"failures": pytest.approx(share)}, "fail_above": limit,
            "failed": code == 3,
        }  # fmt: skip


def test_the_help_says_of_what_the_share_is() -> None:
    """In play of executions and of states met; on recorded data of known failures, as :func:`audited` counts them."""
    text = " ".join(run("audit", "--help").out.replace("│", " ").split())
    assert "in play, of executions or of states met" in text
    assert "on recorded data, of states labelled as failures" in text


def test_what_nobody_could_measure_is_no_share(tmp_path: Path, capsys: Any) -> None:
    """Without a known failure there is no share: exit code 3, and the line says why."""
    data = tmp_path / "data.h5"
    states = States(np.zeros((3, 4), np.float32), np.ones((3, 1), bool), {})
    write_dataset(data, Collected((4,), (GOAL,), states, states, states), domain="", config={}, seed=0)
    words = ["audit", f"{__name__}:certain", "--data", str(data), "--out", str(tmp_path / "audit")]
    assert main([*words, "--fail-above", "0.1"]) == 3
    printed = capsys.readouterr().out
    assert "FAILED: there was nothing to count false positives among: failures" in printed
    assert "more than" not in printed


torch.manual_seed(0)
NET = nn.Sequential(nn.BatchNorm1d(4, momentum=None), nn.Dropout(0.5), nn.Linear(4, 1), nn.Sigmoid())


def scores(observations: Any) -> Any:
    """In whichever mode it is."""
    return NET(torch.from_numpy(observations))[:, 0]


def drawn(observations: Any) -> Any:
    with torch.no_grad():
        return torch.dropout(torch.from_numpy(observations), 0.5, True)[:, 0].sigmoid().numpy()


def grouped(observations: Any) -> Any:
    """Numbers in deviations from their mean in the batch."""
    return (observations[:, 0] > observations[:, 0].mean()).astype(float)


def centred(observations: Any) -> Any:
    observations -= 1
    return torch.from_numpy(observations[:, 0]).sigmoid().bfloat16()


def words(observations: Any) -> Any:
    return ["yes"] * len(observations)


@pytest.mark.parametrize("name", ["scores", "drawn", "grouped"])
def test_a_classifier_of_one_state_at_a_time(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """BatchNorm and Dropout in training mode would give numbers by chance; in play as on recorded data."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    states = np.random.default_rng(0).normal(size=(40, 4)).astype(np.float32)
    NET.train()
    with pytest.raises(UserError, match=r"probabilities that differ by .* call eval"):
        OwnClassifier(f"{__name__}:{name}").predict(states)
    few = OwnClassifier(f"{__name__}:{name}")
    with pytest.raises(UserError, match="probabilities that differ by"):
        [few.predict(states[start : start + 4]) for start in range(0, 40, 4)]


def test_a_classifier_may_answer_in_any_precision_and_change_its_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is given copies; what requires a gradient, or is bfloat16, is a number; words are one line."""
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    states = np.random.default_rng(0).normal(size=(40, 4)).astype(np.float32)
    before = states.copy()
    NET.eval()
    assert OwnClassifier(f"{__name__}:scores").predict(states).shape == (40, 1)
    found = OwnClassifier(f"{__name__}:centred").predict(states)[:, 0]
    np.testing.assert_allclose(found, 1 / (1 + np.exp(1 - before[:, 0])), atol=0.01)
    np.testing.assert_array_equal(states, before)
    with pytest.raises(UserError, match="the classifier gave list"):
        OwnClassifier(f"{__name__}:words").predict(states)


def test_what_is_labelled_next_becomes_data(mixed_run: Path, tmp_path: Path) -> None:
    """Each state of the table is a picture; filled in, it is imported, and the audit is whole."""
    audit = shutil.copytree(mixed_run / "audit", tmp_path / "audit")
    table = audit / "next" / GOAL / TO_FILL_IN
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    before = open_dataset(mixed_run / "data.h5")
    unlabelled = before.unlabelled()
    for row in rows:
        with PIL.Image.open(table.with_name(row["name"])) as image:
            np.testing.assert_array_equal(np.asarray(image), picture_of(unlabelled[int(row["row"])]))
    text = table.read_text()
    for row, answer in zip(rows[:4], "1010", strict=True):
        line = next(line for line in text.splitlines() if row["digest"] in line)
        row["label"] = answer
        text = text.replace(line, ",".join(row.values()))
    table.write_text(text)
    run("verify", audit)
    more = tmp_path / "more.h5"
    run("import", mixed_run / "data.h5", "--label", f"{GOAL}={table}", "--out", more, "-q")
    after = open_dataset(more)
    places = [int(row["row"]) for row in rows[:4]]
    labelled = after.labelled(GOAL)
    np.testing.assert_array_equal(labelled.observations[-4:], unlabelled[places])
    assert labelled.labels[-4:].tolist() == [True, False, True, False] and len(labelled.labels) == 44
    np.testing.assert_array_equal(after.unlabelled(), np.delete(unlabelled, places))
    np.testing.assert_array_equal(after.heldout(GOAL).observations, before.heldout(GOAL).observations)


def test_a_data_file_is_taken_as_it_is(mixed_run: Path, tmp_path: Path) -> None:
    """What ``import`` would do to other sources is not silently left out."""
    table = mixed_run / "audit/next" / GOAL / TO_FILL_IN
    command = ["import", mixed_run / "data.h5", "--label", f"{GOAL}={table}", "--out", tmp_path / "more.h5"]
    for words in (["--resize", "32"], ["--every", "2"], ["--domain", "doorkey"], ["--key", "front"], ["--stack"]):
        refuses("a data file is taken as it is", *command, *words)


def test_a_table_is_of_one_sub_goal(mixed_run: Path, tmp_path: Path) -> None:
    """Data of two sub-goals can be audited."""
    arrays = mixed.arrays()
    for name in ("labels", "heldout_labels"):
        arrays[name] = np.stack([arrays[name], ~arrays[name]], axis=1)
    np.savez(tmp_path / "states.npz", **arrays)
    folder = tmp_path / "run"
    goals = ["--sub-goal", "one", "--sub-goal", "two"]
    run("import", tmp_path / "states.npz", *goals, "--out", folder / "data.h5", "-q")
    few = settings("steps=2", "members=1", "diversity=none", "workers=1")
    run("train-ensemble", folder / "data.h5", "--out", folder / "ensemble", "-q", *few)
    for words in (["--sub-goal", "one", "--out", str(folder / "of-one")], ["--out", str(folder / "audit")]):
        run("audit", folder / "ensemble", *words)
    assert {path.name for path in (folder / "audit/next").iterdir()} == {"one", "two"}


def test_what_cannot_be_audited_is_one_line(mixed_run: Path, tmp_path: Path) -> None:
    """No ensemble, settings, an unknown sub-goal, another artefact; nothing is left behind."""
    ensemble, out = str(mixed_run / "ensemble"), tmp_path / "audit"
    for words, fault in [
        (["mine:classify"], "an audit plays in a domain, or looks at recorded data"),
        ([ensemble, "--set", "steps=3"], "without settings"),
        ([ensemble, "--member", "1"], "an audit plays in a domain"),
        ([ensemble, "--sub-goal", "other"], "unknown sub-goal"),
        ([ensemble, "--domain", "doorkey"], "the domain has the truth"),
        ([mixed_run / "audit"], "but ensemble is needed"),
    ]:
        refuses(fault, "audit", *words, "--out", out)


def test_members_disagree_about_their_own_thresholds() -> None:
    """0 where both say the same, 1 where they are sure of opposites; of one member its own prediction."""
    both = np.array([[0.5, 0.9], [1.0, 0.0], [0.999, 0.9999]])
    found = disagreement(both, np.array([0.5, 0.9]))
    np.testing.assert_allclose(found[:2], [0.0, 1.0], atol=1e-6)
    assert found[2] < 0.01
    np.testing.assert_allclose(
        disagreement(np.array([[0.9], [1.0], [0.0]]), np.array([0.9])), [0.5, 1.0, 0.0], atol=1e-6
    )
    pairs = disagreement(np.array([[0.0, 0.0, 1.0]]), np.full(3, 0.5))
    np.testing.assert_allclose(pairs, [2 / 3], atol=1e-6)  # two of three pairs


def test_states_to_label_are_disputed_common_and_unlike_each_other() -> None:
    """Two crowds that are disputed get one each before either gets a second; a stray state comes after, others last."""
    rng = np.random.default_rng(0)
    crowds = [rng.normal(place, 0.1, (20, 2)) for place in ((0, 0), (5, 0), (0, 5))]
    sketches = np.concatenate([*crowds, [[40.0, 40.0]]])
    scores = np.repeat([0.9, 0.0, 0.8, 0.95], [20, 20, 20, 1])
    rows = to_label(scores * density_of(sketches), sketches, 4)
    assert sorted(row // 20 for row in rows[:2].tolist()) == [0, 2]
    assert 60 not in rows.tolist(), "whatever its score, nothing else is like it"
    assert len({*rows.tolist()}) == 4 and all(scores[rows] > 0)
    np.testing.assert_array_equal(to_label(np.ones(3), sketches[:3], 9).shape, (3,))
    np.testing.assert_array_equal(to_label(np.ones(1), sketches[:1], 1), [0])


def test_members_are_told_apart_by_what_they_alone_call_positive() -> None:
    labels = np.array([True, False, False, True, False])
    scores = np.array([[0.9, 0.9], [0.2, 0.6], [0.7, 0.1], [0.1, 0.1], [0.4, 0.4]])
    unlabelled = np.array([[0.9, 0.1], [0.9, 0.9], [0.1, 0.1]])
    table = member_table(labels, scores, unlabelled, np.array([0.5, 0.5]))
    assert table["negatives"].tolist() == [3, 3] and table["false_positives"].tolist() == [1, 1]
    assert table["highest_negative"].tolist() == [0.7, 0.6]
    assert table["positive_unlabelled"].tolist() == pytest.approx([2 / 3, 1 / 3])
    assert table["positive_alone"].tolist() == pytest.approx([1 / 3, 0])


def test_sketches_are_alike_where_states_are() -> None:
    """Pictures and numbers count alike, whatever their sizes and units."""
    rng = np.random.default_rng(0)
    kinds = np.arange(40) % 4
    cameras = rng.integers(0, 20, (40, 32, 32, 3), dtype=np.uint8)
    cameras[kinds % 2 == 1, :16] += 200
    numbers = rng.normal(0, 10, (40, 3)).astype(np.float32)
    numbers[kinds >= 2] += 1e4
    sketches = sketches_of(packed({"camera": cameras, "numbers": numbers}))
    distance = np.linalg.norm(sketches[:, None] - sketches[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_array_equal(kinds[distance.argmin(1)], kinds)


def test_the_line_names_members_that_hold_all_states_for_the_same() -> None:
    """Of one classifier, which cannot disagree, the line says how many unlabelled states it predicts positive."""
    rows = [
        {"member": member, "negatives": 4, "false_positives": 0, "highest_negative": 0.1, "positive_unlabelled": share}
        for member, share in enumerate((1.0, 0.25, 0.0))
    ]
    part = {"sub_goal": "door", "unlabelled": 8, "disagreement": 1.0, "members": rows}
    several, alone = lines_of("audited.txt", parts=[part, part | {"members": rows[1:2]}])
    assert "100.0% of 8 unlabelled states (the same prediction for all of them: member 0, 2)" in several
    assert "the classifier predicts 25.0% of 8 unlabelled states positive" in alone and "disagree" not in alone
