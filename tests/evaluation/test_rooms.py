"""Spec F1, F2: Figure 3's numbers against values worked by hand: unseen rooms, validation, kinds of false positives."""

import numpy as np
import pytest
from works import methods, work_of

from hypogoal.evaluation import distance
from hypogoal.evaluation.distance import ladder_names, rooms_shown
from hypogoal.evaluation.numbers import groups_of, method_names
from hypogoal.evaluation.rooms import SCORED, choose, missing, rooms_table, rows_by_room
from hypogoal.evaluation.table import VALIDATED, Number, per_run, rows_by_member, rows_of, with_members

YES, NO = True, False
# Rooms 1 (labelled), 9 (unlabelled), 6 (unseen): two positives and two negatives each; 20 (unseen): two negatives.
ROOMS = np.array([1, 1, 1, 1, 9, 9, 9, 9, 6, 6, 6, 6, 20, 20])
SEEN = np.array([2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0])
LABELS = np.array([YES, YES, NO, NO] * 3 + [NO, NO])
ORIGINS = {"room": ROOMS, "seen": SEEN}
VERDICTS = np.array(
    [
        # knows room 1 by heart; knows bases; says yes to all
        *([YES, YES, YES], [YES, YES, YES], [NO, NO, YES], [NO, YES, YES]),  # room 1
        *([NO, YES, YES], [NO, YES, YES], [NO, NO, YES], [NO, NO, YES]),  # room 9
        *([NO, YES, YES], [NO, YES, YES], [NO, NO, YES], [YES, YES, YES]),  # room 6
        *([NO, NO, YES], [YES, NO, YES]),  # room 20
    ]
)


def judged(seen=SEEN):
    """The rows of these members."""
    return list(rows_by_room(VERDICTS.astype(np.float32), VERDICTS, LABELS, {**ORIGINS, "seen": seen}))


def scopes_of(rows):
    return {entry["scope"]: entry for entry in with_members(rows, scope="scope")}


def score(rows, quantity, member):
    """A score on unseen rooms of one of the members."""
    ((_, value),) = per_run(rows, Number(quantity, "unseen", member=member))
    return value


def test_each_scope_by_hand():
    """Spec F1: the member that knows the training room by heart is the best where that room counts least."""
    scopes = scopes_of(judged())
    unseen, everything, labelled = (scopes[name] for name in ("unseen", "all", "labelled"))
    assert (unseen["states"], unseen["positives"], unseen["rooms"]) == (6, 2, 2)
    assert (everything["states"], everything["positives"], everything["rooms"]) == (14, 6, 4)
    assert (labelled["states"], labelled["positives"], labelled["rooms"]) == (4, 2, 1)

    def of(scope, score):
        return [member[score] for member in scope["members"]]

    assert of(labelled, "balanced_accuracy") == pytest.approx([1, (1 + 1 / 2) / 2, 1 / 2])
    assert of(unseen, "balanced_accuracy") == pytest.approx([(0 + 2 / 4) / 2, (1 + 3 / 4) / 2, 1 / 2])
    assert of(unseen, "accuracy") == pytest.approx([2 / 6, 5 / 6, 2 / 6])
    assert of(unseen, "precision") == pytest.approx([0, 2 / 3, 2 / 6])
    assert of(everything, "recall") == pytest.approx([2 / 6, 1, 1])
    assert of(everything, "accuracy") == pytest.approx([8 / 14, 12 / 14, 6 / 14])


def test_validation_picks_by_the_labelled_rooms_only():
    """Spec F1: the member chosen there may be the worst elsewhere; its score on unseen rooms is what it is."""
    rows = judged()
    labelled = scopes_of(rows)["labelled"]
    assert (labelled[VALIDATED], labelled["validation"]) == (0, 1.0)
    scores = [score(rows, "balanced_accuracy", member) for member in ("best", VALIDATED, "mean", "worst")]
    assert scores == pytest.approx([7 / 8, 1 / 4, (1 / 4 + 7 / 8 + 1 / 2) / 3, 1 / 4])
    assert score(rows, "accuracy", VALIDATED) == pytest.approx(2 / 6)


def test_validation_says_when_it_cannot_choose():
    """Spec F1: of members that are equally good the first; none without both classes."""
    same = np.repeat(VERDICTS[:, :1], 3, axis=1)
    assert choose(same, LABELS, SEEN) == {VALIDATED: 0, "validation": 1.0}
    nothing = choose(VERDICTS, LABELS, np.zeros_like(SEEN))
    assert nothing[VALIDATED] is None
    assert np.isnan(nothing["validation"])
    assert np.isnan(score(judged(np.zeros_like(SEEN)), "balanced_accuracy", VALIDATED))


def test_no_positive_in_unseen_rooms_is_said():
    """Spec F1: with every ladder labelled balanced accuracy on unseen rooms is not a number, accuracy is."""
    seen = np.where(ROOMS == 20, 0, 2)
    rows = judged(seen)
    scopes = scopes_of(rows)
    assert scopes["unseen"]["positives"] == 0
    picks = ("best", VALIDATED, "mean", "worst")
    assert np.isnan([score(rows, "balanced_accuracy", member) for member in picks]).all()
    assert score(rows, "accuracy", "best") == 1
    assert scopes["labelled"][VALIDATED] == 1


def ensemble(groups, seed, best, method="dbat, K=2"):
    """Rows of five members, whose mean is best - 0.1; validation picks the second."""
    place = {"method": method, "N": groups, "seed": seed, "artefact": f"{method} {groups} {seed}", "sub_goal": "down"}
    scores = best - np.array([0, 0.2, 0.3, 0, 0])
    for scope in ("unseen", "all"):
        yield from rows_by_member(dict.fromkeys(SCORED, scores), **place, scope=scope)
        yield from rows_of({"states": 12, "positives": 3}, **place, scope=scope)
    yield from rows_of({VALIDATED: 1}, **place, scope="labelled")
    yield from rows_of({"disagreement": 0.1 * seed}, **place, scope="unlabelled")
    yield from rows_of({"disagreement": 0.2}, **place, scope="heldout")


def test_the_table_over_seeds():
    """Spec F1: Figure 3: mean and deviation over seeds, by method and N in their order; F2's numbers beside."""
    rows = rooms_table(
        [
            *ensemble(2, 0, 0.9),
            *ensemble(1, 0, 0.6),
            *ensemble(1, 1, 0.8),
            *ensemble(1, 2, float("nan")),
            *ensemble(1, 0, 0.5, "single CNN"),
            *ensemble(1, 0, 0.7, "no diversity, K=2"),
        ]
    )
    assert [(row["method"], row["groups"]) for row in rows] == [
        ("dbat, K=2", 1), ("dbat, K=2", 2), ("no diversity, K=2", 1), ("single CNN", 1),
    ]  # fmt: skip
    found = rows[0]["scores"]["unseen"]["balanced_accuracy"]["best"]
    assert (found["mean"], found["n"], rows[0]["ensembles"]) == (pytest.approx(0.7), 2, 3)
    assert found["standard_deviation"] == pytest.approx(np.sqrt(2) * 0.1)
    assert found["standard_error"] == pytest.approx(0.1)
    assert found["interval"] == pytest.approx([0.7 - 12.706 * 0.1, 0.7 + 12.706 * 0.1], abs=1e-3)
    assert rows[0]["scores"]["all"]["accuracy"]["validated"]["mean"] == pytest.approx(0.5)
    assert rows[0]["all_negative"] == {"unseen": 0.75, "all": 0.75}
    assert rows[0]["disagreement_unlabelled"]["mean"] == pytest.approx(0.1)
    alone = rows[3]["scores"]["unseen"]["balanced_accuracy"]["best"]
    assert np.isnan(alone["standard_deviation"])
    assert rooms_table(list(rows_of({"balanced_accuracy": 1.0}, method="x", member=0, scope="heldout"))) == []


def test_all_n_of_a_method_have_one_name():
    """Spec F1: N is an axis, not a method; any other setting that differs splits."""
    base = {"members": 6, "diversity": "dbat", "domain_config": {"groups": 1, "states": 10}}
    more = {**base, "domain_config": {"groups": 2, "states": 10}}
    assert method_names([base, more]) == ["dbat, K=6", "dbat, K=6"]
    other = {**base, "domain_config": {"groups": 2, "states": 20}}
    assert method_names([base, other]) == ["dbat, K=6, states=10", "dbat, K=6, states=20"]
    assert (groups_of(more), groups_of({}), groups_of({"domain_config": None})) == (2, None, None)


def test_options_are_named_after_their_ensembles_method():
    """Spec F3: the ladder is no part of the name, a setting of the options that differs at the same N is."""
    config = {"start": "1L", "steps": 10, "termination": "learned", "members": 6}
    other = {**config, "start": "2-6"}
    assert ladder_names(["dbat", "dbat"], [2, 2], [config, other]) == ["dbat", "dbat"]
    assert ladder_names(["dbat", "dbat"], [1, 2], [config, {**config, "steps": 20}]) == ["dbat", "dbat"]
    assert ladder_names(["dbat", "dbat"], [2, 2], [config, {**other, "steps": 20}]) == [
        "dbat, steps=10",
        "dbat, steps=20",
    ]


def lacking(scored, stopped):
    """What a run with these methods is said to lack."""
    work = work_of(rooms=methods(*scored), distance={"options": methods(*stopped)})
    return [*missing(work), *distance.missing(work)]


def test_what_a_ladder_run_lacks_is_named():
    """Spec F: each missing artefact by its name; nothing is missing from a whole run."""
    names = ("dbat, K=6", "no diversity, K=6, steps=9", "single CNN")
    assert lacking(names, (*names, "oracle termination")) == []
    assert lacking(names[:2], ()) == [
        "no ensemble artefact of a single CNN (Figure 3)",
        "no options artefact of a ladder (Figures 4 and 5)",
    ]
    assert lacking(names, names[1:]) == [
        "no options artefact of D-BAT (Figures 4 and 5)",
        "no options artefact with oracle terminations beside them",
    ]
    assert lacking((), ()) == []


def test_the_rooms_that_are_drawn():
    """Figure 5: the ladder's own rooms first, then those with the most stops, three in all."""
    where = [np.array([7, 7, 6, 6, 6]), np.array([9, 9, 9, 9, 3])]
    assert rooms_shown(where) == [9, 6, 7]
    assert rooms_shown(where, (2, 6)) == [2, 6, 9]
    assert rooms_shown([]) == []
