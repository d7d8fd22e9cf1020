"""Spec A2: train one ensemble of hypotheses per sub-goal; the sub-goals are independent and share the cores."""

from collections.abc import Sequence
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
    from hypogoal.hypotheses.sub_goals import checked, log_of, train_sub_goal
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
        accuracies: list[dict[str, float]] = [{} for _ in jobs]
        draft.checkpoint.mkdir(exist_ok=True)
        in_processes(jobs, allowed(config.workers), accuracies.__setitem__)
        texts = [log_of(draft, sub_goal).read_text(encoding="utf-8") for sub_goal in sub_goals]
        (draft.files / LOG).write_text("".join(texts), encoding="utf-8")
    then = "" if installed_domain(dataset.domain) else "evaluate {run}"  # recorded states have no world to practise in
    return Done(_outcome(accuracies), then=then)


def _outcome(accuracies: Sequence[dict[str, float]]) -> list[str]:
    """Best, mean and worst member, means over the sub-goals that can be judged."""
    means = {}
    for name, title in TITLES.items():
        values = [each[name] for each in accuracies if not isnan(each[name])]
        if values:
            means[title] = fmean(values)
    return outcome_of(means)
