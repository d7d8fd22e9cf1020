"""The stage that trains one ensemble of hypotheses per sub-goal. Sub-goals are independent, and share the cores."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from math import isnan
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from typer import Argument, Option

from hypogoal.command.call import Call, Done, outcome_of
from hypogoal.command.stage import stage
from hypogoal.core.artefacts import LOG

TITLES = {
    "best": "held-out balanced accuracy: best member",
    "mean": "mean",
    "worst": "worst",
}
IDLE = "Give unlabelled states in which one rule is true and another one false, or fewer members."
ELSEWHERE = (
    "Take the unlabelled states from this data file, or from an agent or options that were trained with the setting "
    "save_visited. May be repeated."
)


@stage(
    "train-ensemble data/doorkey.h5 --out runs/mine/ensemble",
    often=["members", "diversity", "diversity_weight", "network", "steps"],
    then="train-options {out} --out {run}/options",
)
def train_ensemble(
    call: Call,
    data: Annotated[Path, Argument(help="The data file (HDF5) that 'collect' or 'import' wrote.")],
    *,
    unlabelled: Annotated[list[Path] | None, Option(help=ELSEWHERE)] = None,
) -> Done:
    """Train diverse classifiers (members) for each sub-goal.

    ``unlabelled`` are data files, or artefacts with visited states, whose unlabelled states are taken instead of those
    of ``data``. Each sub-goal has its own progress line, and its own folder for TensorBoard.
    """
    from hypogoal.core.processes import allowed, in_processes
    from hypogoal.data import open_dataset
    from hypogoal.domains.find import installed_domain
    from hypogoal.hypotheses.config import TrainEnsembleConfig
    from hypogoal.hypotheses.sub_goals import Trained, checked, log_of, train_sub_goal
    from hypogoal.observations import type_text
    from hypogoal.options.visited import unlabelled_file

    dataset = open_dataset(data)
    config, sub_goals = checked(call.settings(TrainEnsembleConfig, dataset.domain), dataset)
    others = [unlabelled_file(path, dataset) for path in unlabelled or ()]
    settings = config.model_dump(mode="json") | {
        "sub_goals": sub_goals,
        "observation_shape": dataset.observation_shape,
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
        chosen = {sub_goal: trained[number].chosen for number, sub_goal in enumerate(sub_goals)}
        settings["chosen"] = chosen
        texts = [log_of(draft, sub_goal).read_text(encoding="utf-8") for sub_goal in sub_goals]
        (draft.files / LOG).write_text("".join(texts), encoding="utf-8")
    then = "" if installed_domain(dataset.domain) else "evaluate {run}"  # recorded states have no world to practise in
    lines = [*chain.from_iterable(_choice(*each) for each in chosen.items())]
    return Done([*lines, *_outcome([each.accuracies for each in trained.values()])], then=then)


def _choice(sub_goal: str, chosen: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on what was chosen for a sub-goal, and on which of its members are no hypotheses."""
    trials = chosen["tried"]
    if trials:
        held_out = f"{chosen['positives']} positives, {chosen['negatives']} negatives held out"
        yield f"{sub_goal}: diversity_weight={chosen['diversity_weight']:g}, by {held_out}"
        yield f"  weight  accuracy there (at least {chosen['lowest']:.3f})  disagreement on unlabelled states"
    for tried in trials:
        differs = "-" if tried["disagreement"] is None else f"{tried['disagreement']:.2f}"
        remark = ""
        if tried["kept"]:
            remark = "  chosen"
        elif tried["constant"]:
            remark = "  a member is constant"
        elif tried["contrary"]:
            remark = "  on more than half"
        yield f"  {tried['weight']:<6g}  {tried['accuracy']:<32.3f}  {differs}{remark}"
    if trials and not trials[-1]["kept"]:
        yield "  members keep the labels with none of these weights, so the smallest is taken"
    if chosen["remark"]:
        yield f"{sub_goal}: {chosen['remark']}"
    for text in chosen["idle"]:
        yield f"{sub_goal}: {text}, so it is no hypothesis of its own. {IDLE}"


def _outcome(accuracies: Sequence[dict[str, float]]) -> list[str]:
    """Return a line on the best, mean and worst member, as means over the sub-goals that can be judged."""
    means = {}
    for name, title in TITLES.items():
        values = [each[name] for each in accuracies if not isnan(each[name])]
        if values:
            means[title] = fmean(values)
    return outcome_of(means)
