"""What each number in ``metrics.json`` is: its unit and its meaning."""

QUANTITIES: dict[str, dict[str, str]] = {
    "balanced_accuracy": {
        "unit": "fraction",
        "meaning": "mean of recall and of the share of negatives called negative",
    },
    "precision": {"unit": "fraction", "meaning": "positives among the states that a member calls positive"},
    "recall": {"unit": "fraction", "meaning": "share of positives that a member calls positive"},
    "accuracy": {"unit": "fraction", "meaning": "share of states that a member calls right"},
    "f1": {"unit": "fraction", "meaning": "harmonic mean of precision and recall; misleads where positives abound"},
    "says_yes_unlabelled": {"unit": "fraction", "meaning": "share of unlabelled states that a member calls positive"},
    "disagreement": {"unit": "fraction", "meaning": "share of states on which two members' verdicts differ"},
    "success": {"unit": "fraction", "meaning": "share of the last 100 training episodes that reached the goal"},
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
    "mean": {"unit": "as said beside it", "meaning": "over runs"},
    "standard_error": {"unit": "as said beside it", "meaning": "of the mean over runs"},
    "iqm": {"unit": "as said beside it", "meaning": "interquartile mean over runs"},
    "interval": {"unit": "as said beside it", "meaning": "95 % bootstrap interval of the interquartile mean"},
    "n": {"unit": "runs", "meaning": "runs that have this number"},
}
