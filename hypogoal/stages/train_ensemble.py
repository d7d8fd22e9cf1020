"""Spec A2: train one ensemble of hypotheses per sub-goal; the sub-goals are independent and share the cores."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from math import isnan
from pathlib import Path
from statistics import fmean
from typing import Annotated

from typer import Argument, Option

from hypogoal.core.artefacts import LOG
from hypogoal.stages import Call, Done, outcome_of, stage

TITLES = {
    "best": "held-out balanced accuracy: best member",
    "mean": "mean",
    "worst": "worst",
}
IDLE = "Unlabelled states in which features part help, or diversity_weight=auto, or fewer members."
ELSEWHERE = "Take unlabelled states from a data file, or options or a meta-policy with save_visited; repeatable."


@stage(
    "train-ensemble data/doorkey.h5 --out runs/mine/ensemble",
    often=["members", "diversity", "diversity_weight", "network", "steps"],
    then="train-options {out} --out {run}/options",
)
def train_ensemble(
    call: Call,
    data: Annotated[Path, Argument(help="The HDF5 file that 'collect' wrote.")],
    *,
    unlabelled: Annotated[list[Path] | None, Option(help=ELSEWHERE)] = None,
) -> Done:
    """Train diverse classifiers (members) of each sub-goal.

    Spec B7: ``unlabelled`` are data files, or artefacts with visited states, whose unlabelled states are taken instead
    of those of ``data``. Each sub-goal has a progress line and a folder of TensorBoard's of its own.
    """
    from hypogoal.core.processes import allowed, in_processes
    from hypogoal.data import open_dataset
    from hypogoal.domains.base import installed_domain
    from hypogoal.hypotheses.sub_goals import Trained, checked, log_of, train_sub_goal
    from hypogoal.observations import type_text
    from hypogoal.options.visited import unlabelled_file

    dataset = open_dataset(data)
    config, sub_goals = checked(call.settings(dataset.domain), dataset)
    others = [unlabelled_file(path, dataset) for path in unlabelled or ()]
    settings = config.model_dump(mode="json") | {
        "sub_goals": list(sub_goals),
        "observation_shape": list(dataset.observation_shape),
        "observation_dtype": type_text(dataset.observation_dtype),
        "domain": dataset.domain,
        "domain_config": dataset.config,
    }
    with call.draft("ensemble", settings, [data, *others]) as draft:
        jobs = []
        for sub_goal in sub_goals:
            board = Path(call.tensorboard, sub_goal) if call.tensorboard else None
            job = partial(
                train_sub_goal,
                draft,
                data,
                others,
                sub_goal,
                config,
                call.seed,
                call.device,
                board,
                quiet=call.quiet,
            )
            jobs.append(job)
        trained: dict[int, Trained] = {}
        draft.checkpoint.mkdir(exist_ok=True)
        in_processes(jobs, allowed(config.workers), trained.__setitem__)
        by_goal = {sub_goal: trained[number] for number, sub_goal in enumerate(sub_goals)}
        settings["chosen"] = {goal: {**asdict(each.choice), "idle": each.idle} for goal, each in by_goal.items()}
        texts = [log_of(draft, sub_goal).read_text(encoding="utf-8") for sub_goal in sub_goals]
        (draft.files / LOG).write_text("".join(texts), encoding="utf-8")
    then = "" if installed_domain(dataset.domain) else "evaluate {run}"  # recorded states have no world to practise in
    lines = []
    for sub_goal, each in by_goal.items():
        lines += each.choice.lines(sub_goal)
        lines += [f"{sub_goal}: {text}, so it is no hypothesis of its own" for text in each.idle]
    if any(each.idle for each in by_goal.values()):
        lines.append(IDLE)
    return Done([*lines, *_outcome([each.accuracies for each in by_goal.values()])], then=then)


def _outcome(accuracies: Sequence[dict[str, float]]) -> list[str]:
    """Best, mean and worst member, means over the sub-goals that can be judged."""
    means = {}
    for name, title in TITLES.items():
        values = [each[name] for each in accuracies if not isnan(each[name])]
        if values:
            means[title] = fmean(values)
    return outcome_of(means)
