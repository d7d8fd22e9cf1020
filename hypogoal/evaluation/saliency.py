"""Figures 2 and 9, and a gallery: what each member looks at in held-out states (Spec F2, F6)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.evaluation.attributing import look as look
from hypogoal.evaluation.attributing import outcomes
from hypogoal.evaluation.page import Drawn, Results, picture
from hypogoal.evaluation.pictures import SIGNED, attribution_image, coloured
from hypogoal.evaluation.plots import legend_below, panels, plot, styled

TITLE = "What members look at"
MOST_BARS = 15  # features
NEEDED = dict.fromkeys(("figure2", "figure9"), "an ensemble on pictures that has positive predictions")


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
        columns = {"sub_goal": sub_goal}
        if "features" in facts:
            bars = bars_of_features(arrays["attributions"], facts["features"])
            yield Drawn(f"features{suffix}", "What members go by", bars, columns)
            continue
        columns |= {"kind": facts["kinds"][0], "place": facts["places"][0]}
        state = {name: values[0] for name, values in arrays.items()}
        figure2 = attributions_of_members(state, facts["colours"])
        yield Drawn(f"figure2{suffix}", "Figure 2: attributions of each member", figure2, columns)
        figure9 = attributions_of_channels(state, facts["colours"])
        yield Drawn(f"figure9{suffix}", "Figure 9: attributions of every frame", figure9, columns)


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
