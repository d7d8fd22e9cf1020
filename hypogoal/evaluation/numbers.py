"""The statistics of an evaluation: means, intervals, pairs of runs, and the names of what is compared (Spec F5).

Runs that were not made alike are never averaged: they have different names.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit
from scipy.stats import binomtest, bootstrap, trim_mean

from hypogoal.core.seeding import rng_for

DIGITS = 9  # rounding errors of sums of thousands of shares are far smaller, intended differences far larger
ROUNDING = 10.0**-DIGITS
Metrics = Mapping[str, Any]
Rows = list[dict[str, Any]]
Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)
RESAMPLES = 2_000
CONFIDENCE = 0.95
# Values from which on there is a bootstrap: of 2 values it would hold in 49 % of cases, of 5 in 85 %.
BOOTSTRAP_FROM = 8
STUDENT = "Student's t of the mean"
# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {
        *("layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"),
        *("world", "members", "observation_dtype"),  # which the domain's settings and the ensemble's name say
        *("ended_at", "until_reached", "options_ended_at"),  # which came out
    }
)
# Settings of ensembles without effect.
IDLE = {"single CNN": {"diversity", "diversity_weight", "schedule", "members"}, "no diversity": {"diversity_weight"}}
METHODS = {"dbat": "D-BAT", "no diversity": "an ensemble without diversity", "single CNN": "a single CNN"}
ORACLE = "oracle termination"
OBJECTIVES = {"dbat": "D-BAT", "divdis": "DivDis"}
ONE = "one classifier"


def at_least(values: Any, bound: Any) -> Any:
    """Whether values (...) are at least ``bound`` (...), up to rounding, as .3 - .1 is .2: bool (...)."""
    return values >= bound - ROUNDING


def above(values: Any, bound: Any) -> Any:
    """Whether values (...) exceed ``bound`` (...) by more than rounding: bool (...)."""
    return values > bound + ROUNDING


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """The items by their key, in the order in which keys and items come."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


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


def mean_of(values: ArrayLike) -> float:
    """The mean of (n,), NaN where there are none."""
    numbers = np.asarray(values)
    return float(numbers.mean()) if len(numbers) else math.nan


def mean_and_error(values: NDArray[np.float64]) -> tuple[float, float]:
    """Spec F5: mean and standard error of the mean (n - 1 in the variance) of (n,); the error of one value is NaN."""
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.nan
    return mean_of(values), error


def interquartile_mean(values: NDArray[np.float64], axis: int = -1) -> Any:
    """Spec F5: the mean of the middle half: a quarter of the values, rounded down, is cut off at either end."""
    return trim_mean(values, 0.25, axis=axis)


def by_unit(values: ArrayLike, units: Sequence[Hashable]) -> NDArray[np.float64]:
    """The mean of each unit's values, (n, ...) to (U, ...), in the order in which units come; a NaN is left out."""
    numbers, names = np.asarray(values, np.float64), list(dict.fromkeys(units))
    belongs = np.zeros((len(names), len(numbers)))
    belongs[[names.index(unit) for unit in units], range(len(numbers))] = 1
    counts, sums = np.tensordot(belongs, ~np.isnan(numbers), 1), np.tensordot(belongs, np.nan_to_num(numbers), 1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def by_layout(values: ArrayLike, layouts: Sequence[Hashable]) -> tuple[NDArray[np.float64], str]:
    """Spec F5: the independent values: each layout's mean over its runs or, with one layout, the runs themselves.

    Takes n runs' values (n, ...) and layouts, empty where they have none. Returns (U, ...), and "layouts" or "runs".
    """
    several = len(set(layouts)) > 1
    return by_unit(values, layouts if several else range(len(np.asarray(values)))), "layouts" if several else "runs"


def student_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Spec F5: Student's 95 % interval of the mean of (n,) independent values; NaN for fewer than two."""
    mean, error = mean_and_error(values)
    wide = float(stdtrit(max(1, len(values) - 1), (1 + CONFIDENCE) / 2)) * error
    return mean - wide, mean + wide


def interval(values: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float, str]:
    """Spec F5: a 95 % interval of (n,) independent values, and its kind; NaN for fewer than two.

    Below 8 values Student's, of the mean: a percentile bootstrap of two would hold in half of the cases. From 8 on a
    bootstrap of the interquartile mean, whose resamples ``rng`` draws (SciPy's: rliable's fails with pandas 3).
    """
    if len(values) < BOOTSTRAP_FROM:
        return *student_interval(values), STUDENT if len(values) > 1 else "no interval"
    how: dict[str, Any] = {"n_resamples": RESAMPLES, "confidence_level": CONFIDENCE, "method": "percentile"}
    bounds = bootstrap([values], interquartile_mean, **how, vectorized=True, rng=rng).confidence_interval
    return float(bounds.low), float(bounds.high), "bootstrap of the interquartile mean"


def over(
    values: Sequence[float], unit: str, *cell: str, layouts: Sequence[Hashable] = (), deviation: bool = False
) -> dict[str, Any]:
    """Spec F5: the statistics of a number over runs; runs of one layout count once, by their mean.

    Runs with a NaN are left out, and ``n`` shows it. ``cell``, the names that identify the number, seeds the resamples;
    ``layouts`` as for :func:`by_layout`. Returns mean, standard_error, iqm, interval (95 %), interval_over (its units
    and kind), n (runs), unit, and with ``deviation`` standard_deviation (n - 1).
    """
    defined = [index for index, value in enumerate(values) if not np.isnan(value)]
    of_runs = [values[index] for index in defined], [layouts[index] for index in defined if layouts]
    numbers, unit_names = by_layout(*of_runs)
    mean, error = mean_and_error(numbers)
    low, high, kind = interval(numbers, rng_for(0, "bootstrap", *cell))
    statistics = {
        "mean": mean,
        "standard_error": error,
        "iqm": float(interquartile_mean(numbers)) if len(numbers) else math.nan,
        "interval": [low, high],
        "interval_over": f"{unit_names}: {kind}",
        "n": len(defined),
        "unit": unit,
    }
    if deviation:
        statistics["standard_deviation"] = float(numbers.std(ddof=1)) if len(numbers) > 1 else math.nan
    return statistics


def pairs(
    measured: Iterable[tuple[str, tuple[Hashable, ...], float]],
    quantity: str,
    where: str = "",
    *,
    higher: bool = True,
) -> Rows:
    """Spec F5: the first method against each of the others, over what both share, see :func:`compare_pairs`.

    Pairs that share layout, data and first weights tell more than two means: these may differ by one run.

    ``measured`` are (method, key, value). A key is what pairs must share: layout, sub-goal or ladder, and last the
    seed; values with the same key are paired in order. Where there are several layouts, they are the units, else seeds.
    """
    values: dict[str, dict[tuple[Hashable, ...], float]] = {}
    for method, key, value in measured:
        of_method = values.setdefault(method, {})
        of_method[*key, sum(other[:-1] == key for other in of_method)] = value
    first, *others = values or ("",)
    rows = []
    for second in others:
        shared = [key for key in values[first] if key in values[second]]
        if shared:
            ours, theirs = (np.array([values[name][key] for key in shared], np.float64) for name in (first, second))
            several = len({key[0] for key in shared}) > 1
            units = [key[:1] if several else key[-2:] for key in shared]
            entry = {"first": first, "second": second, "quantity": quantity, "where": where, "higher": higher}
            rows.append({**entry, **compare_pairs(ours, theirs, units, higher=higher)})
    return rows


def compare_pairs(
    first: NDArray[np.float64], second: NDArray[np.float64], units: Sequence[Hashable], *, higher: bool = True
) -> dict[str, Any]:
    """Spec F5: the first of two methods against the second over n pairs of runs that share layout and seed.

    The probability of improvement is the share of pairs in which the first is better, a tie counting half. Pairs of one
    unit (one ensemble on several ladders, one layout with several seeds) are not independent: everything but the counts
    is over units, each of which counts once, by its mean. Pairs with a NaN are left out.

    Returns:
        n, units (how many), wins, ties, probability and its interval (Student's 95 %, cut at 0 and 1), interval_over,
        difference (mean of first - second) and difference_interval, sign_test (two-sided p, ties left out). NaN without
        pairs; intervals are NaN for one unit too.
    """
    defined = ~(np.isnan(first) | np.isnan(second))
    marks = [mark for mark, both in zip(units, defined, strict=True) if both]
    difference = first[defined] - second[defined]
    better = np.sign((difference if higher else -difference).round(DIGITS))
    scores, differences = (by_unit(values, marks) for values in ((1 + better) / 2, difference))
    won, lost = int((scores > 0.5).sum()), int((scores < 0.5).sum())
    return {
        "n": len(difference),
        "units": len(scores),
        "wins": int((better > 0).sum()),
        "ties": int((better == 0).sum()),
        "probability": mean_of(scores),
        "interval": np.clip(student_interval(scores), 0, 1).tolist(),
        "interval_over": f"units: {STUDENT}",
        "difference": mean_of(differences),
        "difference_interval": list(student_interval(differences)),
        "sign_test": float(binomtest(won, won + lost).pvalue) if won + lost else math.nan,
    }


def name_apart(
    bases: Sequence[str], configs: Sequence[Mapping[str, Any]], groups: Sequence[int | None] = ()
) -> list[str]:
    """A name for each of n things: its base name, and the settings by which it differs from most of that base name.

    ``domain_config`` inside the settings is looked into. Of several ``groups`` (N) only things of the same are named
    apart.
    """
    flat = [{**(config.get("domain_config") or {}), **config, "domain_config": None} for config in configs]
    kinds = list(zip(bases, groups or [None] * len(bases), strict=True))
    names = []
    for base, kind, config in zip(bases, kinds, flat, strict=True):
        alike = [other for other, others_kind in zip(flat, kinds, strict=True) if others_kind == kind]
        differing = []
        for key in sorted({key for other in alike for key in other} - NOT_A_VARIANT):
            if key not in config:  # of a learner or a chooser that this one is not
                continue
            values = [_text(other[key]) for other in alike if key in other]
            usual, count = Counter(values).most_common(1)[0]
            if (text := _text(config[key])) != usual or 2 * count <= len(values):
                differing.append(f"{key}={text}")
        names.append(", ".join([base, *differing]))
    return names


def _text(value: Any) -> str:
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def ensemble_name(config: Mapping[str, Any]) -> str:
    """How an ensemble is called in tables: its objective and its number of members."""
    objective = "no diversity" if config["diversity"] == "none" else config["diversity"]
    return "single CNN" if config["members"] == 1 else f"{objective}, K={config['members']}"


def ensemble_title(name: str) -> str:
    """'dbat, K=3' for people: 'D-BAT, 3 members'."""
    objective, members, rest = (*name.split(", ", 2), "", "")[:3]
    if name.startswith("single CNN"):
        return name.replace("single CNN", ONE)
    size = members.replace("K=", "") + " members" if members.startswith("K=") else members
    return ", ".join(filter(None, [OBJECTIVES.get(objective, objective), size, rest]))


def ensemble_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles; those whose settings differ are kept apart, settings without effect left out."""
    bases = [ensemble_name(config) for config in configs]
    settings = []
    for base, config in zip(bases, configs, strict=True):
        idle = IDLE.get(base.partition(",")[0], set())
        settings.append({key: value for key, value in config.items() if key not in idle})
    return name_apart(bases, settings)


def method_names(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of ensembles as methods: as :func:`ensemble_names`, with all N under one name."""
    inner = [{**(config.get("domain_config") or {}), "groups": None} for config in configs]
    return ensemble_names([{**config, "domain_config": domain} for config, domain in zip(configs, inner, strict=True)])


def methods_lacking(entries: Iterable[Mapping[str, Any]], artefact: str, figures: str) -> list[str]:
    """A line for each of the paper's methods that no entry has an artefact of."""
    methods = [entry["method"] for entry in entries]
    lacking = [name for start, name in METHODS.items() if not any(method.startswith(start) for method in methods)]
    return [f"no {artefact} artefact of {name} ({figures})" for name in lacking]


def groups_of(config: Mapping[str, Any]) -> int | None:
    """N, the number of labelled ladder groups that an ensemble's data have; None where its domain has no such thing."""
    groups = (config.get("domain_config") or {}).get("groups")
    return groups if isinstance(groups, int) else None


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
