"""Compute each bold number of the results pages, and README's table and picture, a second way: from the cells alone.

It takes nothing from the package or other studies, and ends with a line for each number off by more than a last digit.
``recomputed.csv`` has what a page shows, in its order: names of numbers below, and numbers that are no results.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
BOLD = re.compile(r"\*\*(.+?)\*\*", re.DOTALL)
ROW = re.compile(r"^\| [^|]*\|(.*)$", re.MULTILINE)
NO_NUMBER = re.compile(r"`[^`]*`|\]\([^)]*\)|\b\d+-\d+\b|\*\*")  # code, links, ladders
NUMBER = re.compile(r"(?<![\w.-])-?(?:\d[\d,]*(?:\.\d+)?|\.\d+)|never(?=\])")
ENDS = ["mean", "min", "max"]
METHODS = {"auto": "auto", "none": "no diversity", "one": "one classifier", "unpaired": "auto, unpaired"}
Found = dict[str, Any]


def score(values: Any) -> list[float]:
    """The mean, and the bootstrap's interval of Student's t by the published resamples."""
    numbers = np.asarray(values, float)
    drawn = numbers[np.random.default_rng(0).integers(len(numbers), size=(20_000, len(numbers)))]
    differ = drawn[np.ptp(drawn, axis=1) > 0]
    low, high = np.percentile((differ.mean(axis=1) - numbers.mean()) / stats.sem(differ, axis=1), [2.5, 97.5])
    return [numbers.mean(), numbers.mean() - high * stats.sem(numbers), numbers.mean() - low * stats.sem(numbers)]


def share(values: Any) -> list[float]:
    """The mean and Gaffke's bounds, by the gaps between sorted even numbers."""
    numbers = np.sort(np.asarray(values, float))
    even = np.sort(np.random.default_rng(1).random((100_000, len(numbers))), axis=1)
    gaps = np.diff(even, axis=1, prepend=0, append=1)
    low, high = gaps[:, 1:] @ numbers, gaps @ np.append(numbers, 1)
    return [numbers.mean(), np.percentile(low, 2.5), np.percentile(high, 97.5)]


def median(values: Any) -> list[float]:
    """The median, and the two values between which it lies in 95 of 100 cases."""
    numbers = sorted(values)
    cut = max(k for k in range(len(numbers) // 2) if stats.binom.cdf(k - 1, len(numbers), 0.5) < 0.025)
    return [float(np.median(numbers)), numbers[cut - 1], numbers[-cut]]


def compare(found: Found, name: str, apart: Any, bounds: Any = score) -> None:
    """Keep what pairs say: a middle with its interval, and the count of those above 0."""
    found[name], found[f"won-{name}"] = bounds(apart), [(apart > 1e-9).sum(), len(apart)]


def cells(name: str, **wanted: Any) -> Any:
    """The rows of a CSV that have these values."""
    rows = pd.read_csv(ROOT / f"docs/results/{name}.csv")
    return rows[np.logical_and.reduce([rows[key] == value for key, value in wanted.items()] or [rows.index >= 0])]


def played(name: str, chooser: str = "agent", quantity: str = "success", **wanted: str) -> Any:
    """A number of agents: a row for each layout, a column for each method."""
    rows = cells(name, chooser=chooser, quantity=quantity, **wanted)
    return rows.pivot(index="layout", columns="method", values="value")


def crossed(members: Any, name: str) -> Any:
    """The mean over both halves of the member that is best on the other."""
    on_second = members[f"{name}_second"].iloc[members[f"{name}_first"].argmax()]
    return (on_second + members[f"{name}_first"].iloc[members[f"{name}_second"].argmax()]) / 2


def of_hypotheses(found: Found) -> None:
    """What members know."""
    of_goal = cells("hypotheses-doorkey", layouts="test").groupby(["method", "sub_goal", "seed"])
    ranking = of_goal.apply(crossed, "ranking").unstack()
    accuracy = of_goal.apply(crossed, "balanced_accuracy").groupby(["method", "seed"]).mean()
    apart = ranking.loc["dbat"] - ranking.loc["dbat-unpaired"]
    found["dbat"], found["control"] = ranking.loc["dbat"].mean().mean(), ranking.loc["dbat-unpaired"].mean().mean()
    compare(found, "pairing", apart.mean())
    found["green-behind"] = np.abs(score(apart.loc["collect-green-key"]))[[0, 2, 1]]
    found["red"] = score(apart.loc["collect-red-key"])
    found["accuracy"] = accuracy["dbat"].mean()
    compare(found, "accuracy-apart", accuracy["dbat"] - accuracy["cnn"])
    common = cells("figure2-ladders", step=300).groupby(["method", "seed"])["common"].mean()
    found["attention"], found["attention-none"] = common["dbat"].mean(), common["none"].mean()
    found["attention-apart"] = score(common["dbat"] - common["none"])
    ladders: dict[str, Any] = {}
    for method, looks in cells("figure3-ladders", groups=1).groupby("method"):
        halves = []
        for pick, judge in (("first", "second"), ("second", "first")):
            best = looks.groupby(["step", "seed"])[f"ranking_{pick}"].max().groupby("step").mean()
            own = looks[looks["step"] == best.idxmax()]
            picked = own.loc[own.groupby("seed")[f"ranking_{pick}"].idxmax()].set_index("seed")[f"ranking_{judge}"]
            of_seed = own.groupby("seed")
            halves.append([picked, of_seed[f"ranking_{judge}"].mean(), of_seed["balanced_accuracy_all"].max()])
        ladders[method] = [(first + second) / 2 for first, second in zip(*halves, strict=True)]
    for other in ("cnn", "dbat-unpaired", "none"):
        compare(found, f"ladders-{other}", ladders["dbat"][0] - ladders[other][0])
    compare(found, "mean-behind", ladders["dbat-unpaired"][1] - ladders["dbat"][1])
    compare(found, "everywhere", ladders["dbat"][2] - ladders["cnn"][2])


def of_options(found: Found) -> None:
    """Where options stop."""
    rows = cells("figure4-ladders", groups=1)
    new = rows[rows["ladder"].isin(["2-6", "3-9", "14-22", "0-4", "5-11", "7-13"])]
    best = new.groupby(["method", "seed", "ladder"])[["distance", "stop_distance"]].min()
    stops = best.groupby(["method", "seed"]).mean()
    for other in ("none", "cnn"):
        apart = stops.loc[other] - stops.loc["dbat"]
        compare(found, f"stop-{other}", apart["distance"], median)
        found[f"true-{other}"] = median(-apart["stop_distance"].dropna())  # how much farther D-BAT is
    found["at-base"] = cells("figure5-ladders", fate=2, method="none").groupby("seed")["count"].sum().max()
    means = cells("options-that-hold").groupby(["method", "seed", "ladder"], sort=False)["distance"].mean()
    found["ends"] = means["holds-dbat"].unstack().drop(columns=["0-4", "5-11", "7-13"]).dropna().mean(axis=1).agg(ENDS)
    in_order = means.groupby(["ladder", "method"]).mean().unstack()[["holds-dbat", "holds-none", "oracle"]]
    table = in_order.loc["1L 1M 1R 2-6 3-9 14-22 0-4 5-11 7-13 4-10 11-19 13-21".split()]  # noqa: SIM905
    found["each-ladder"] = table.stack().dropna()
    picked = {}
    for method in ("dbat", "none", "planned", "none-planned"):
        own = cells("distilled", method=method, step=1)
        shares = own.pivot(index=["seed", "sub_goal", "member"], columns="layouts", values="within_2")
        at_best = shares.groupby(["seed", "sub_goal"])["trained"].idxmax()
        picked[method] = shares.loc[at_best, "new"].groupby("seed").mean()
    found["picked"], found["picked-none"] = score(picked["dbat"]), score(picked["none"])
    for name, other in (("dbat", "none"), ("planned", "none-planned")):
        found[f"{name}-picked-apart"] = score(picked[name] - picked[other])


def of_agents(found: Found) -> None:
    """What agents solve on DoorKey."""
    steps = played("figure6-doorkey", quantity="steps_to_95")
    found |= np.isfinite(steps).sum().to_dict()
    found["later"] = median(steps["dqn-tuned"] / steps["dbat-k3"])
    for policy in ("planned", "learned"):
        found[f"prefer-{policy}"] = share(
            played("preference-doorkey", quantity="pair", policy=policy)["dbat-k3"].dropna()
        )
        for chooser in ("agent", "uniform"):
            solved = played("choosing-doorkey", chooser, policy=policy)
            found |= {f"{policy}-{chooser}-{method}": share(solved[method]) for method in ("dbat", "none", "one")}
    found["one-layout"] = played("choosing-doorkey", policy="learned").loc[70100, ["dbat", "one"]]
    for world in ("many", "many-harsh"):
        rows = cells("distilled-agents", world=world, options="distilled")
        found[world], found[f"{world}-uniform"] = rows["within_2"].agg(ENDS), rows["within_2_uniform"].mean()
        found["solvable"] = rows["solvable"].max()


def of_rooms(found: Found) -> None:
    """What agents solve in rooms."""
    runs = pd.concat([played(f"rooms{run}") for run in ("-joint", "", "-second", "-first")])
    for method in ("dbat", "none", "one"):
        found[f"both-{method}"] = share((runs[f"{method}-truth-shape"] + runs[f"{method}-truth-place"]) / 2)
    compare(found, "shape-lead", runs["dbat-truth-shape"] - runs["none-truth-shape"], np.mean)
    found["place-behind"] = (runs["none-truth-place"] - runs["dbat-truth-place"]).mean()
    joint = played("rooms-joint")
    for truth in ("shape", "place"):
        found[f"joint-{truth}"] = median(joint[f"joint-truth-{truth}"] - joint[f"dbat-truth-{truth}"])
    weight = cells("weight").pivot(index="seed", columns="method")
    owned = (weight["owned_shape"] >= 0.9) & (weight["owned_place"] >= 0.9)
    solved = (weight["solved_shape"] + weight["solved_place"]) / 2
    for name, method in METHODS.items():
        compare(found, f"owned-{name}", owned[method].astype(int), np.mean)
        compare(found, f"gain-{name}", solved["auto"] - solved[method], median)
        found |= {f"{name}-{truth}": share(weight[f"solved_{truth}"][method]) for truth in ("shape", "place")}


def of_levels(found: Found) -> None:
    """What members own and agents solve where labels fit colour and shape."""
    for world, rows in cells("misgeneralise").groupby("world"):
        own = rows.pivot(index="seed", columns="method")
        owned = (own["owned_colour"] >= 0.9) & (own["owned_shape"] >= 0.9)
        late = own["solved_51_100_colour"], own["solved_51_100_shape"]
        both = (late[0] + late[1]) / 2
        for name in own["owned_colour"]:
            key = f"{world}-{name.replace(' ', '-').replace(',', '')}"
            found[f"{key}-owned"] = [owned[name].sum(), len(owned)]
            found[f"{key}-worse"] = share(np.minimum(*(solved[name] for solved in late)))
            compare(found, f"{key}-gain", both["independent"] - both[name], median)
            for task, solved in zip(("colour", "shape"), late, strict=True):
                found[f"{key}-{task}"] = share(solved[name])
                found[f"{key}-{task}-early"] = share(own[f"solved_11_20_{task}"][name])


def of_episodes(found: Found) -> None:
    """How many episodes choosing takes."""
    agents = cells("symbols").replace({"episodes_to_95": {np.nan: np.inf}})
    for (world, chooser), rows in agents.groupby(["world", "chooser"]):
        found[f"{world}-{chooser}"] = rows["episodes_to_95"].median()
        found[f"{world}-{chooser}-most"] = rows["episodes_to_95"].max()
    planned = agents[agents["world"] == "planned"].pivot(index="layout", columns="chooser", values="episodes_to_95")
    found["times"] = (planned["ppo-16"] / planned["symbols"]).median()


def shown_in(root: Path, where: str) -> list[str]:
    """The numbers of README's table and picture, or those in bold on a page, without code and addresses."""
    name = "README.md" if where == "README" else f"docs/results/{where}.md"
    page = (root / name).read_text("utf-8")
    parts = ROW.findall(page) if where == "README" else BOLD.findall(page)
    with Image.open(root / "docs/results.png") as picture:
        of_picture = picture.info["Description"].split() if where == "README" else []
    return NUMBER.findall(NO_NUMBER.sub(" ", " ; ".join(parts))) + of_picture


def differences(root: Path = ROOT) -> Iterator[str]:
    """A line for each number under a folder that is off by more than its last digit."""
    found: Found = {}
    for part in (of_hypotheses, of_options, of_agents, of_rooms, of_levels, of_episodes):
        part(found)
    found |= {f"mean-{name}": np.ravel(value)[0] for name, value in found.items()}
    for where, names in cells("recomputed").to_numpy():
        shown = shown_in(root, where)
        known = [(name, float(value)) for name in names.split() for value in np.ravel(found.get(name, name))]
        if len(shown) != len(known):
            yield f"{where}: {len(shown)} numbers are shown, {len(known)} are recomputed"
        for text, (name, value) in zip(shown, known, strict=False):
            number = np.inf if text == "never" else float(text.replace(",", ""))
            if number != value and not abs(number - value) <= 1.001 * 10.0 ** -len(text.partition(".")[2]):
                yield f"{where}, {name}: {text} is shown, {value:.5g} is recomputed"


if __name__ == "__main__":
    sys.exit("\n".join(differences()) or None)
