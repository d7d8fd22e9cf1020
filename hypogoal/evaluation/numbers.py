"""An evaluation's numbers: one table of rows, every mean, interval and comparison, and what each means (Spec F5).

Nothing is averaged over runs that were not made alike: what differs has another name.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap, trim_mean

from hypogoal.core.seeding import rng_for

Metrics = Mapping[str, Any]
Rows = list[dict[str, Any]]
RESAMPLES = 2_000
CONFIDENCE = 0.95
# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {"layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"}
)
# Settings of ensembles without effect.
IDLE = {
    "single CNN": {"diversity", "diversity_weight", "schedule", "members"},
    "no diversity": {"diversity_weight"},
}
METHODS = {"dbat": "D-BAT", "no diversity": "an ensemble without diversity", "single CNN": "a single CNN"}
ORACLE = "oracle termination"
QUANTITIES: dict[str, dict[str, str]] = {
    "balanced_accuracy": {
        "unit": "fraction",
        "meaning": "mean of recall and of the share of negatives called negative",
    },
    "precision": {"unit": "fraction", "meaning": "positives among the states that a member calls positive"},
    "recall": {"unit": "fraction", "meaning": "share of positives that a member calls positive"},
    "accuracy": {"unit": "fraction", "meaning": "share of states that a member calls right"},
    "f1": {"unit": "fraction", "meaning": "harmonic mean of precision and recall; misleads where positives abound"},
    "ranking": {
        "unit": "fraction",
        "meaning": "share of pairs of a positive and a negative in which a member gives the positive the higher "
        "probability: the area under the ROC curve, whatever the threshold",
    },
    "says_yes_unlabelled": {"unit": "fraction", "meaning": "share of unlabelled states that a member calls positive"},
    "disagreement": {"unit": "fraction", "meaning": "share of states on which two members' verdicts differ"},
    "success": {
        "unit": "fraction",
        "meaning": "share of the last 100 training episodes that succeeded: terminated with a reward above 0",
    },
    "reward": {"unit": "reward", "meaning": "mean undiscounted reward of the last 100 training episodes"},
    "length": {
        "unit": "steps",
        "meaning": "mean length of the last 100 training episodes, failures at the cap included",
    },
    "length_over_shortest": {"unit": "ratio", "meaning": "length / the layout's shortest path"},
    "discounted_return": {
        "unit": "reward",
        "meaning": "mean of 0.99 ** (length - 1) * reward over the last 100 episodes",
    },
    "steps_to_95": {
        "unit": "environment steps",
        "meaning": "first step at which 95 of the last 100 episodes succeeded; steps of train-options count",
    },
    "steps": {"unit": "environment steps", "meaning": "budget, summed over parallel environments and stages"},
    "shortest_path": {"unit": "steps", "meaning": "primitive steps from the start to the goal, at least"},
    "random_success": {"unit": "fraction", "meaning": "share of episodes of uniformly random actions that succeed"},
    "groups": {"unit": "ladder groups", "meaning": "N: how many ladder groups the labelled states are from"},
    "seen": {
        "unit": "code",
        "meaning": "a held-out state's room: 0 in no training set, 1 among the unlabelled, 2 among the labelled states",
    },
    "scopes": {
        "unit": "rooms",
        "meaning": "unseen: seen is 0; all: every held-out room, the paper's way; labelled: seen is 2, for validation",
    },
    "best": {"unit": "as said beside it", "meaning": "of the members: the highest score, or the least distance"},
    "worst": {"unit": "as said beside it", "meaning": "of the members: the lowest score, or the greatest distance"},
    "validated": {
        "unit": "as said beside it",
        "meaning": "of the member with the highest balanced accuracy on the labelled rooms, the first of several",
    },
    "always_no": {"unit": "fraction", "meaning": "accuracy of a member that never says yes: the share of negatives"},
    "validation": {"unit": "fraction", "meaning": "the validated member's balanced accuracy on the labelled rooms"},
    "tied": {"unit": "members", "meaning": "members that have that balanced accuracy; in tables the mean over seeds"},
    "false_positives": {
        "unit": "fraction",
        "meaning": "per kind of negatives, each member's share that it calls positive",
    },
    "executions": {"unit": "executions", "meaning": "the last ones of an option that count, 100 at most"},
    "distance": {
        "unit": "units of position",
        "meaning": "mean over executions of the way from where it stopped to the nearest true base, through the rooms; "
        "300 for one that began inside its own termination set",
    },
    "executions_deviation": {
        "unit": "units of position",
        "meaning": "standard deviation of that over an option's last executions; in tables the best member's",
    },
    "reached_base": {
        "unit": "fraction",
        "meaning": "share of executions that stopped within 4 of a true base and did not begin inside",
    },
    "inside_at_start": {"unit": "fraction", "meaning": "share of executions that began in their own termination set"},
    "timed_out": {"unit": "fraction", "meaning": "share of executions that neither their classifier nor a death ended"},
    "died": {"unit": "fraction", "meaning": "share of executions that ended in a terminal state of the episode"},
    "log_odds": {
        "unit": "log-odds",
        "meaning": "a member's difference of logits, positive: reached more likely than not",
    },
    "baseline_log_odds": {"unit": "log-odds", "meaning": "the same of the baseline that a state is compared with"},
    "attributed": {"unit": "log-odds", "meaning": "sum of a state's DeepLift attributions over pixels and frames"},
    "completeness_error": {
        "unit": "log-odds",
        "meaning": "|attributed - (log_odds - baseline_log_odds)|; 0 but for rounding if attributions are complete",
    },
    "shown": {"unit": "states", "meaning": "held-out states of a sub-goal that the page lets one browse"},
    "explained": {"unit": "states", "meaning": "those of them whose attributions are kept"},
    "last_frame": {"unit": "fraction", "meaning": "share of all attribution, absolute, that is in the last channel"},
    "match": {
        "unit": "fraction",
        "meaning": "a member's balanced accuracy against the true sub-goal on the layout's reachable states",
    },
    "expected": {"unit": "decisions", "meaning": "sum of 1 / (options offered) over the decisions that offered it"},
    "offered": {"unit": "decisions", "meaning": "decisions at which the option was not masked"},
    "chosen": {"unit": "decisions", "meaning": "decisions that chose the option"},
    "reached": {"unit": "executions", "meaning": "executions that ended because the option's own classifier said yes"},
    "duration": {"unit": "steps", "meaning": "mean steps of an execution"},
    "preference": {"unit": "ratio", "meaning": "chosen / expected; 1 for a chooser that does not care"},
    "late_preference": {"unit": "ratio", "meaning": "preference over the last quarter of training"},
    "share": {"unit": "fraction", "meaning": "chosen / all decisions; confounded by how often an option is offered"},
    "rank_correlation": {
        "unit": "Spearman's rho, -1..1",
        "meaning": "with the match; 'all': over all options, 'within': mean over sub-goals of that among members",
    },
    "probability": {
        "unit": "fraction",
        "meaning": "share of pairs of runs, alike in layout and seed, in which the first is better; a tie counts half",
    },
    "units": {"unit": "layouts or seeds", "meaning": "that pairs are of: those of one are not independent"},
    "wins": {"unit": "pairs", "meaning": "in which the first is better"},
    "ties": {"unit": "pairs", "meaning": "in which both are the same"},
    "difference": {"unit": "as said beside it", "meaning": "mean over pairs of first - second"},
    "difference_interval": {"unit": "as said beside it", "meaning": "95 % bootstrap interval of the difference"},
    "sign_test": {
        "unit": "probability",
        "meaning": "of units won and lost as unevenly as these if neither were better",
    },
    "mean": {"unit": "as said beside it", "meaning": "over runs"},
    "standard_error": {"unit": "as said beside it", "meaning": "of the mean over runs"},
    "iqm": {"unit": "as said beside it", "meaning": "interquartile mean over runs"},
    "interval": {
        "unit": "as said beside it",
        "meaning": "95 % bootstrap interval, of the interquartile mean or probability",
    },
    "standard_deviation": {"unit": "as said beside it", "meaning": "over runs (n - 1)"},
    "n": {"unit": "runs", "meaning": "runs that have this number"},
}


class Row(NamedTuple):
    """One number of ``numbers.csv`` and what it is of; empty where that is not said of it.

    Attributes:
        quantity, value: see ``QUANTITIES``.
        method: the ensemble's, or the agent's name.
        sub_goal, member: of which.
        scope: the states that it is over.
        N: labelled ladder groups.
        ladder, layout, seed: of the training.
        step: environment steps after which it was so.
        artefact: its path within the run.
    """

    quantity: str
    value: float | int
    method: str = ""
    sub_goal: str = ""
    member: int | str = ""
    scope: str = ""
    N: int | None = None
    ladder: str = ""
    layout: int | str = ""
    seed: int | str = ""
    step: int | str = ""
    artefact: str = ""


def rows_of(numbers: Mapping[str, Any], **place: Any) -> Iterable[Row]:
    """A row for each finite number among them, all of one place."""
    for name, value in numbers.items():
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            yield Row(name, value, **place)


def plain(value: Any) -> Any:
    """JSON-ready: NaN becomes null, NumPy numbers become Python's."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def mean_and_error(values: NDArray[np.float64]) -> tuple[float, float]:
    """Spec F5: mean and standard error of the mean (n - 1 in the variance) of (n,); the error of one value is NaN."""
    if len(values) == 0:
        return float("nan"), float("nan")
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
    return float(values.mean()), error


def interquartile_mean(values: NDArray[np.float64], axis: int = -1) -> Any:
    """Spec F5: the mean of the middle half (a quarter of the values, rounded down, is cut off at either end)."""
    return trim_mean(values, 0.25, axis=axis)


def bootstrap_interval(
    values: NDArray[np.float64],
    strata: Sequence[Hashable],
    rng: np.random.Generator,
    statistic: Callable[..., Any] = interquartile_mean,
) -> tuple[float, float, str]:
    """Spec F5: 95 % percentile bootstrap interval of the interquartile mean, or of another statistic.

    Runs are drawn again within their stratum (a layout), so the interval speaks of these layouts with other seeds.
    Where a layout has a single run there is nothing to draw within it: then runs are drawn from all of them, and the
    interval speaks of other layouts too.

    Args:
        values: float (n,), one per run.
        strata: n hashable marks.
        rng: draws the resamples.
        statistic: takes values and ``axis``.

    Returns:
        Lower and upper bound, NaN for fewer than two runs, and over what was resampled.
    """
    if len(values) < 2:
        return float("nan"), float("nan"), "one run: no interval"
    marks = sorted(set(strata), key=str)
    groups = [values[[mark == own for own in strata]] for mark in marks]
    if min(len(group) for group in groups) < 2:
        groups, over = [values], "runs"
    else:
        over = "runs within layouts" if len(groups) > 1 else "runs"
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0]), over

    def together(*resampled: NDArray[np.float64], axis: int = -1) -> Any:
        return statistic(np.concatenate(resampled, axis=axis), axis=axis)

    found = bootstrap(
        groups,
        together,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=rng,
    ).confidence_interval
    return float(found.low), float(found.high), over


def over(
    values: Sequence[float],
    unit: str,
    *cell: str,
    strata: Sequence[Hashable] | None = None,
    deviation: bool = False,
) -> dict[str, Any]:
    """Spec F5: everything said of a number over runs. Runs whose number is NaN are left out and ``n`` says so.

    Args:
        values: one per run.
        unit: theirs.
        cell: names of this number among all; they seed the resamples.
        strata: a mark per run, see :func:`bootstrap_interval`.
        deviation: with the standard deviation over runs (n - 1), the bands of Figures 3 and 4.

    Returns:
        mean, standard_error, iqm, interval (95 %, of the iqm), interval_over, n, unit.
    """
    known = np.array([value for value in values if not np.isnan(value)], dtype=np.float64)
    marks = [mark for value, mark in zip(values, strata or [0] * len(values), strict=True) if not np.isnan(value)]
    mean, error = mean_and_error(known)
    low, high, drawn = bootstrap_interval(known, marks, rng_for(0, "bootstrap", *cell))
    found = {
        "mean": mean,
        "standard_error": error,
        "iqm": float(interquartile_mean(known)) if len(known) else float("nan"),
        "interval": [low, high],
        "interval_over": drawn,
        "n": len(known),
        "unit": unit,
    }
    if deviation:
        found["standard_deviation"] = float(known.std(ddof=1)) if len(known) > 1 else float("nan")
    return found


def pairs(
    measured: Iterable[tuple[str, tuple[Hashable, ...], float]],
    quantity: str,
    where: str = "",
    *,
    higher: bool = True,
    layouts: bool = False,
) -> Rows:
    """Spec F5: the first method against each other over what both have alike, seed by seed.

    A seed's layout, data and first weights are hard or easy for every method, so pairs that share them tell more than
    two means; and the probability of improvement says how often, where a difference of means may be one run's.

    Args:
        measured: (method, what is alike, value): layout, sub-goal or ladder, the seed last. What is alike in all of it,
            options of one seed of several ensembles say, is paired in the order in which it comes.
        quantity: what the rows say that is compared.
        where: and of what.
        higher: the better value is the higher one.
        layouts: the first mark's values are the units, not the seeds.

    Returns:
        A row for each method after the first that shares a pair with it, see :func:`compare_pairs`.
    """
    values: dict[str, dict[tuple[Hashable, ...], float]] = {}
    for method, key, value in measured:
        own = values.setdefault(method, {})
        before = sum(known[:-1] == key for known in own)
        own[*key, before] = value
    first, *others = values or ("",)
    rows = []
    for second in others:
        shared = [key for key in values[first] if key in values[second]]
        if not shared:
            continue
        one, other = (np.array([values[name][key] for key in shared], dtype=np.float64) for name in (first, second))
        rng = rng_for(0, "bootstrap", "pairs", first, second, quantity, where)
        units = [key[:1] if layouts else key[-2:] for key in shared]
        found = compare_pairs(one, other, units, rng, within=layouts, higher=higher)
        rows.append({"first": first, "second": second, "quantity": quantity, "where": where, "higher": higher, **found})
    return rows


def compare_pairs(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    units: Sequence[Hashable],
    rng: np.random.Generator,
    *,
    within: bool = False,
    higher: bool = True,
) -> dict[str, Any]:
    """Spec F5: the first of two methods against the second over n pairs of runs that share layout and seed.

    The probability of improvement is the share of pairs in which the first is better, a tie counting half. Pairs of one
    unit (one seed's ensemble on several ladders, one layout with several seeds) are not independent: interval and sign
    test are over units, each of which counts once, by its mean. Where one wins every pair there is nothing to resample
    and the interval has no width, so the sign test stands beside it, which few units cannot make small.

    Args:
        first: float (n,), pair by pair; pairs with a NaN are left out.
        second: float (n,), of the other method.
        units: n hashable marks.
        rng: draws the resamples.
        within: the intervals, not the sign test, are drawn within units where each has several pairs: they speak of
            these layouts with other seeds (see :func:`bootstrap_interval`).
        higher: the better value is the higher one.

    Returns:
        n, units (how many), wins, ties, probability, interval (95 %) and interval_over, difference (mean of
        first - second) and difference_interval (95 %), sign_test (two-sided p, ties left out). NaN without pairs.
    """
    known = ~(np.isnan(first) | np.isnan(second))
    marks = [mark for mark, one in zip(units, known, strict=True) if one]
    difference = first[known] - second[known]
    better = np.sign(difference if higher else -difference)
    scores = (1 + better) / 2
    count, wins, ties = len(scores), int((better > 0).sum()), int((better == 0).sum())
    of_units, differences = (_by_unit(values, marks) for values in (scores, difference))
    if within:
        low, high, over = bootstrap_interval(scores, marks, rng, np.mean)
        *around, _ = bootstrap_interval(difference, marks, rng, np.mean)
    else:
        nothing = [0] * len(of_units)
        low, high, over = bootstrap_interval(of_units, nothing, rng, np.mean)
        *around, _ = bootstrap_interval(differences, nothing, rng, np.mean)
    won, lost = int((of_units > 0.5).sum()), int((of_units < 0.5).sum())
    return {
        "n": count,
        "units": len(of_units),
        "wins": wins,
        "ties": ties,
        "probability": float(scores.mean()) if count else float("nan"),
        "interval": [low, high],
        "interval_over": over,
        "difference": float(difference.mean()) if count else float("nan"),
        "difference_interval": list(around),
        "sign_test": float(binomtest(won, won + lost).pvalue) if won + lost else float("nan"),
    }


def _by_unit(values: NDArray[np.float64], marks: Sequence[Hashable]) -> NDArray[np.float64]:
    """The mean of each unit's values, in the order in which units come."""
    return np.array([values[[mark == own for own in marks]].mean() for mark in dict.fromkeys(marks)], dtype=np.float64)


def name_apart(bases: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name for each of n things: its base name, and where settings differ within that, those settings.

    What more than half of the things of one base name have in common goes unsaid.

    Args:
        bases: n names.
        configs: n resolved settings; ``domain_config`` inside is looked into.
    """
    flat = [_flat(config) for config in configs]
    names = []
    for base, own in zip(bases, flat, strict=True):
        same = [other for other, name in zip(flat, bases, strict=True) if name == base]
        keys = sorted({key for other in same for key in other} - NOT_A_VARIANT)
        varied = [key for key in keys if len({_text(other.get(key)) for other in same}) > 1]
        usual = {key: _usual([_text(other.get(key)) for other in same]) for key in varied}
        said = ((key, _text(own.get(key))) for key in varied)
        suffix = ", ".join(f"{key}={text}" for key, text in said if text != usual[key])
        names.append(f"{base}, {suffix}" if suffix else base)
    return names


def _usual(texts: Sequence[str]) -> str | None:
    """What more than half of them are, None where there is no such thing."""
    text, count = Counter(texts).most_common(1)[0]
    return text if 2 * count > len(texts) else None


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    inner = config.get("domain_config") or {}
    return {**inner, **{key: value for key, value in config.items() if key != "domain_config"}}


def _text(value: Any) -> str:
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def ensemble_name(config: Mapping[str, Any]) -> str:
    """How an ensemble is called in tables: its objective and its number of members.

    One that is told where the agent is, which no observation says, is called what it is: an oracle.
    """
    objective = "no diversity" if config["diversity"] == "none" else config["diversity"]
    name = "single CNN" if config["members"] == 1 else f"{objective}, K={config['members']}"
    told = config.get("view") == "agent-crop" and config.get("localiser") == "ram"
    return f"{name}, position oracle" if told else name


def ensemble_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles; those whose settings differ are kept apart, settings without effect left out."""
    bases = [ensemble_name(config) for config in configs]
    told = [
        {key: value for key, value in config.items() if key not in IDLE.get(base.partition(",")[0], set())}
        for base, config in zip(bases, configs, strict=True)
    ]
    return name_apart(bases, told)


def method_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles as methods: as ``ensembles.ensemble_names``, with all N under one name."""
    alike = []
    for config in configs:
        inner = {key: value for key, value in (config.get("domain_config") or {}).items() if key != "groups"}
        alike.append({**config, "domain_config": inner})
    return ensemble_names(alike)


def groups_of(config: Mapping[str, Any]) -> int | None:
    """N, the number of labelled ladder groups that an ensemble's data have; None where its domain has no such thing."""
    found = (config.get("domain_config") or {}).get("groups")
    return found if isinstance(found, int) else None


def method_rank(method: str) -> int:
    """The order of methods in tables and figures: the paper's method, its control, the single CNN, anything else."""
    starts = ("dbat", "divdis", "no diversity", "single CNN")
    return next((rank for rank, start in enumerate(starts) if method.startswith(start)), len(starts))


def by_groups(entries: Iterable[Mapping[str, Any]]) -> list[int | None]:
    """The Ns of some entries, ascending, None (no such thing) last."""
    return sorted({entry["groups"] for entry in entries}, key=lambda groups: (groups is None, groups or 0))


def by_method(cell: tuple[str, int | None, str]) -> tuple[str, int, str, int]:
    """The order of (method, N, sub-goal) in tables."""
    method, groups, sub_goal = cell
    return sub_goal, method_rank(method), method, -1 if groups is None else groups
