"""What each number in ``metrics.json`` is, its unit and its meaning, and how numbers are written there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

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
