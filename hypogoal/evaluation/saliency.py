"""Figures 2 and 9, and a gallery: what each member looks at in held-out states (Spec F2, F6)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.data import open_dataset
from hypogoal.evaluation.house import tidy_members
from hypogoal.evaluation.judging import Judgement, Work, place_of, states_of
from hypogoal.evaluation.page import Drawn, Results, picture
from hypogoal.evaluation.pictures import SIGNED, attribution_image, coloured
from hypogoal.evaluation.plots import legend_below, panels, plot, styled
from hypogoal.observations import PICTURE, fields_of, spread_rows

TITLE = "What members look at"
GALLERY = 40  # states of all sub-goals
EXPLAINED = 20  # of these with attributions: DeepLift takes .05 s for a state and member
INTEGRATED = 5  # where they are integrated gradients: of a large network seconds
AVERAGED = 64  # states over which attributions to features are averaged
MOST_BARS = 15  # features
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns
NEEDED = dict.fromkeys(("figure2", "figure9"), "an ensemble on pictures that has positive predictions")


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """What members look at in a few held-out states, of the ensemble whose options were learned most often.

    ``saliency/SUB_GOAL`` is written: states with what members predict, ``seen``, what members saw of the first of them,
    and ``attributions`` to it, float32 (n, K, H, W, C), in log-odds, against the mean of the unlabelled states. Of
    numbers, and of pictures and numbers by key, these alone, (n, K, features): a picture's are added up.
    """
    from hypogoal.hypotheses.deep_lift import DEEP_LIFT, attributed, mean_state, method_of

    case, sub_goal, split = judgement.case, judgement.sub_goal, judgement.split
    if judgement.number != work.browsed or not len(split.labels):
        return
    place = work.place_of(judgement)
    looked_at = work.facts.setdefault("looked_at", {"ensemble": place, "sub_goals": {}})
    group = work.arrays.create_group(f"saliency/{sub_goal}")
    dataset, ensemble = open_dataset(case.data), case.read(sub_goal)
    heldout, unlabelled = states_of(case.data)
    observations = heldout[sub_goal].observations
    if dataset.observation_dtype == PICTURE:
        kinds, states = states_to_show(judgement)
        few = EXPLAINED if method_of(ensemble.members[0]) == DEEP_LIFT else INTEGRATED
        explained = states[: max(len(kinds), few // len(case.config["sub_goals"]))]
    else:
        kinds, explained = [], spread_rows(len(split.labels), AVERAGED)
    seen = ensemble.see(observations[explained])
    attributions = attributed(ensemble, seen, mean_state(ensemble.see(unlabelled)))
    error = attributions.completeness_error()
    facts = {"kinds": kinds, "how": attributions.method, "completeness_error": float(error.max())}
    looked_at["sub_goals"][sub_goal] = facts
    if dataset.observation_dtype == PICTURE:
        values: NDArray[np.floating] = attributions.values
        default = 3 if dataset.observation_shape[-1] == 3 else 1
        facts["colours"] = dataset.channels.get("", (1, default))[1]  # of each frame of a stack
        facts["places"] = [place_of(split.origins, state) for state in states]
        shown = {
            "observations": observations[states],
            "labels": split.labels[states],
            "probabilities": judgement.judged.probabilities[states],
            "predictions": judgement.judged.predictions[states],
            "seen": seen,
        }
        for name, array in shown.items():
            group[name] = array
    else:
        values = of_features(attributions.values.reshape(*error.shape, -1), seen.dtype)
        facts["features"] = dataset.features()
    group.create_dataset("attributions", data=values.astype(np.float32), compression="gzip")
    for row, kind in enumerate(kinds):
        columns = {"completeness_error": error[row], "log_odds": attributions.log_odds[row]}
        yield tidy_members(columns, **place, scope=f"state: {kind}")


def states_to_show(judgement: Judgement) -> tuple[list[str], NDArray[np.int64]]:
    """States of the gallery, those of the figures first, and what kinds these are; unseen ones if some are positive."""
    split, judged = judgement.split, judgement.judged
    unseen = split.origins.get("seen", np.zeros(len(split.labels))) == 0
    allowed = unseen if split.labels[unseen].any() else np.ones_like(unseen)
    kinds = pick_to_explain(judged.probabilities, judged.predictions, split.labels, allowed)
    places = {name: split.origins[name] for name in PLACES if name in split.origins}
    rng = rng_for(0, "browse", judgement.sub_goal)
    browsed = pick_for_gallery(judged.predictions, split.labels, places, rng)
    states = pd.unique(np.array([*kinds.values(), *browsed]))
    return [*kinds], states[: GALLERY // len(judgement.case.config["sub_goals"])]


def of_features(values: NDArray[np.floating], dtype: np.dtype[Any]) -> NDArray[np.floating]:
    """Attributions (n, K, D) to each number; of mixed observations those to a picture are added up."""
    from hypogoal.hypotheses.deep_lift import by_key

    if not dtype.names:
        return values
    of_keys = by_key(values, dtype)
    features = []
    for key, (kind, _) in fields_of((), dtype).items():
        flat = of_keys[key].reshape(*values.shape[:2], -1)
        features.append(flat.sum(axis=-1, keepdims=True) if kind == PICTURE else flat)
    return np.concatenate(features, axis=-1)


def pick_to_explain(
    probabilities: NDArray[np.float32],
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
) -> dict[str, int]:
    """Figures 2 and 9: the few of N states, by kind, whose attributions are drawn, no state twice.

    ``true positive``: where most of K members are right and surest on average; ``disagree``: where members differ and
    their probabilities are furthest apart; ``false positive``: where most err, and are surest. Fewer where none are.
    """
    positive = predictions.sum(axis=1)
    some = positive > 0
    surest = -(positive + probabilities.mean(axis=1))
    apart = probabilities.min(axis=1) - probabilities.max(axis=1)
    candidates = {
        "true positive": (labels & some, surest),
        "disagree": (some & ~predictions.all(axis=1), apart),
        "false positive": (~labels & some, surest),
    }
    free = allowed.copy()
    picked = {}
    for kind, (of_kind, order) in candidates.items():
        among = of_kind & free
        if among.any():
            picked[kind] = int(np.where(among, order, np.inf).argmin())
            free[picked[kind]] = False
    return picked


def outcomes(predictions: NDArray[np.bool_], labels: NDArray[np.bool_]) -> NDArray[np.str_]:
    """Of predictions (n, K) of labels (n,): whether all members are right, all wrong, or they disagree."""
    errors = (predictions != labels[:, None]).sum(axis=1)
    return np.select([errors == 0, errors == predictions.shape[1]], ["all right", "all wrong"], "disagree")


def pick_for_gallery(
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    places: Mapping[str, NDArray[np.int64]],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """States by how interesting they are, int64 (N,): kinds of outcome take turns, and within each the places.

    Takes predictions (N, K), labels (N,), places (N,) each. States on which all members are right come last; ``rng``
    draws among states alike.
    """
    kinds = pd.DataFrame({"outcome": outcomes(predictions, labels), "label": labels})
    states = kinds.assign(**places).sample(frac=1, random_state=rng)
    turn = states.groupby([*states]).cumcount()
    states = states.assign(turn=turn).sort_values("turn", kind="stable")
    turn = states.groupby([*kinds]).cumcount()
    right = states["outcome"] == "all right"
    return states.assign(turn=turn, right=right).sort_values(["right", "turn"], kind="stable").index.to_numpy()


def explained(results: Results) -> dict[str, Any]:
    """What is known of each sub-goal that has a figure: a state that members are positive in, or numbers."""
    looked_at = results.facts.get("looked_at") or {"sub_goals": {}}
    return {name: facts for name, facts in looked_at["sub_goals"].items() if facts["kinds"] or "features" in facts}


def context(results: Results) -> dict[str, Any] | None:
    """For the template: whose members, how they were explained, and the states of the gallery."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return None
    states: list[dict[str, Any]] = []
    for name, facts in looked_at["sub_goals"].items():
        arrays = results.within(f"saliency/{name}")
        if "observations" in arrays:
            states += _gallery(arrays, name, facts)
    return {"ensemble": looked_at["ensemble"], "explained": [*explained(results).values()], "states": states}


def _gallery(arrays: Mapping[str, NDArray[Any]], sub_goal: str, facts: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Each state's pictures and what members predict of it."""
    colours = facts["colours"]
    outcome = outcomes(arrays["predictions"], arrays["labels"])
    for index, place in enumerate(facts["places"]):
        maps = []
        if index < len(arrays["seen"]):
            for values in arrays["attributions"][index]:
                maps.append(picture(attribution_image(values, arrays["seen"][index], colours)))
        yield {
            "source": picture(coloured(arrays["observations"][index], colours)),
            "maps": maps,
            "predictions": arrays["predictions"][index],
            "probabilities": arrays["probabilities"][index],
            "truth": arrays["labels"][index],
            "outcome": outcome[index],
            "sub_goal": sub_goal,
            "place": place,
        }


def figures(context: Mapping[str, Any]) -> Iterator[Drawn]:
    """Figures 2 and 9 of each sub-goal, a true positive where there is one; of numbers, which features members use."""
    of_sub_goals = explained(context["results"])
    for sub_goal, facts in of_sub_goals.items():
        arrays = context["results"].within(f"saliency/{sub_goal}")
        suffix = f"-{sub_goal}" if len(of_sub_goals) > 1 else ""
        about = {"sub_goal": sub_goal}
        if "features" in facts:
            bars = bars_of_features(arrays["attributions"], facts["features"])
            yield Drawn(f"features{suffix}", "What members go by", bars, about)
            continue
        about |= {"kind": facts["kinds"][0], "place": facts["places"][0]}
        state = {name: values[0] for name, values in arrays.items()}
        figure2 = attributions_of_members(state, facts["colours"])
        yield Drawn(f"figure2{suffix}", "Figure 2: attributions of each member", figure2, about)
        figure9 = attributions_of_channels(state, facts["colours"])
        yield Drawn(f"figure9{suffix}", "Figure 9: attributions of every frame", figure9, about)


def _said(state: Mapping[str, NDArray[Any]], member: int) -> str:
    says = state["predictions"][member]
    wrong = "" if says == state["labels"] else ", wrong"
    return f"member {member}\n{'positive' if says else 'negative'} {state['probabilities'][member]:.2f}{wrong}"


def attributions_of_members(state: Mapping[str, NDArray[Any]], colours: int) -> Figure:
    """Figure 2: a state and what each member goes by in it; of a stack of frames the last."""
    truth = "positive" if state["labels"] else "negative"
    shown = [(coloured(state["observations"], colours), f"truth\n{truth}")]
    for member, values in enumerate(state["attributions"]):
        shown.append((attribution_image(values, state["seen"], colours), _said(state, member)))
    return panels(shown, min(4, len(shown)), SIGNED)


def attributions_of_channels(state: Mapping[str, NDArray[Any]], colours: int) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of one frame its colours."""
    channels = state["seen"].shape[-1]
    count = channels // colours if channels > colours else channels
    frames = np.split(state["seen"], count, axis=-1)
    names = [f"{age} before" for age in range(count - 1, 0, -1)] + ["newest frame"]
    if channels == colours == 3:
        names = ["red", "green", "blue"]
    shown = [(coloured(frame), name) for frame, name in zip(frames, names, strict=True)]
    for member, values in enumerate(state["attributions"]):
        titles = [_said(state, member)] + [""] * (count - 1)
        for part, frame, title in zip(np.split(values, count, axis=-1), frames, titles, strict=True):
            shown.append((attribution_image(part, frame), title))
    return panels(shown, count, SIGNED)


def bars_of_features(attributions: NDArray[np.floating], names: Sequence[str]) -> Figure:
    """Bars side by side, those of the features that members go by most, of attributions (n, K, features)."""
    sizes = pd.DataFrame(np.abs(attributions).mean(axis=0).T, index=[*names]).add_prefix("member ")
    most = sizes.mean(axis=1).nlargest(MOST_BARS).index
    with styled():
        figure, axes = plot(0.7 + 0.35 * len(most))
        sizes.loc[most[::-1]].plot.barh(ax=axes, width=0.8, legend=False)
        axes.set_xlabel("mean absolute attribution, log-odds")
        legend_below(figure, [axes], 4)
    return figure
