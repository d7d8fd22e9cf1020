"""The settings of ensemble training. This module does not import PyTorch, so that ``hypogoal config`` starts fast."""

from typing import Any, Final, Literal

from pydantic import model_validator

from hypogoal.core.config import Config, setting

BEYOND = "own: beyond the paper"
FULL = "full"  # the view that shows all of an observation
VIEW = "view."  # the prefix of the settings of a user's own view
AUTO: Final = "auto"  # a value that is chosen from the user's own states
SCHEDULES = ("simultaneous", "sequential")
LABELS: Final = "labels"  # stands for the share of positives among the labelled states


class MembersConfig(Config):
    """The members and their training, except the weight of diversity. The defaults are DoorKey's (Table 3)."""

    members: int = setting(
        3,
        "hypotheses for each sub-goal, called members (K); 1 is a single classifier",
        source="Table 3",
        low=1,
        high=64,
    )
    diversity: str = setting(
        "dbat",
        "diversity objective: dbat, none, another one of docs/concepts.md, or your own as module:function",
        source="Eq. (1)",
    )
    teacher: str = setting(
        "",
        "your own code, module:function, that scores the unlabelled states; members learn the scores beside the "
        "labels; empty: no teacher",
        source=f"{BEYOND}: docs/extending.md",
    )
    network: str = setting(
        "auto",
        "network of each member: doorkey, montezuma, tiles, mlp, or your own as module:function; auto takes the first "
        "of doorkey, montezuma and tiles that fits pictures of this size, otherwise mlp; if observations have several "
        "keys, give one for each key, such as front=tiles,state=mlp",
        source="the paper's appendix",
    )
    steps: int = setting(
        150,
        "number of gradient steps of a training, or of each member's training if the schedule is sequential",
        unit="batches",
        source="own choice, the paper has none: docs/results/hypotheses.md",
        low=1,
        high=10_000_000,
    )
    learning_rate: float = setting(2e-4, "Adam's learning rate", source="Table 3", low=0.0, high=1.0)
    l2_weight: float = setting(
        1e-4, "strength of L2 regularisation (Adam's weight decay)", source="Table 3", low=0.0, high=1.0
    )
    batch_size: int = setting(
        64,
        "labelled states in a batch, and also the number of unlabelled states in a batch",
        unit="states",
        source="Table 3",
        low=2,
        high=65536,
    )
    class_weight_negative: float = setting(0.5, "weight of negatives in the cross entropy", source="Table 3", low=1e-6)
    class_weight_positive: float = setting(0.5, "weight of positives in the cross entropy", source="Table 3", low=1e-6)
    unlabelled_bn: bool = setting(
        True,
        "BatchNorm's running statistics include unlabelled batches, so that they cover more than one layout",
        source="the authors' code",
    )
    view: str = setting(
        FULL,
        "what members see of an observation: full, the whole observation; or a view of your own, module:Class",
        source=BEYOND,
    )
    view_settings: tuple[str, ...] = setting(
        (), "settings of your own view as KEY=VALUE; give each by --set view.KEY=VALUE", source=BEYOND
    )
    threshold: str = setting(
        "0.5",
        "the probability above which a member's prediction is positive: a number; unlabelled-split, the probability "
        "that best splits the unlabelled states into two classes; or module:function",
        source=f"{BEYOND}; unlabelled-split: Otsu 1979",
    )

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, values: Any) -> Any:
        """Move the settings of a user's own view, ``view.KEY``, into ``view_settings``."""
        of_view = [name for name in values if name.startswith(VIEW)]
        if not of_view:
            return values
        others = {name: value for name, value in values.items() if name not in of_view}
        settings = [f"{name.removeprefix(VIEW)}={values[name]}" for name in of_view]
        return others | {"view_settings": settings}


class EnsembleConfig(MembersConfig):
    """One training of an ensemble, with the paper's weight and schedule as defaults."""

    diversity_weight: float = setting(1e-4, "weight of the diversity loss (alpha)", source="Table 3, Eq. (1)", low=0.0)
    schedule: str = setting("simultaneous", "train all members at once, or one after the other", choices=SCHEDULES)
    share: float | Literal["labels"] = setting(
        LABELS,
        "share of positives among unlabelled states that the objectives divdis and independent expect",
        low=0.0,
        high=1.0,
        words=[LABELS],
    )


class TrainEnsembleConfig(MembersConfig):
    """The settings of ``train-ensemble``, which trains the ensembles of several sub-goals."""

    diversity_weight: float | Literal["auto"] = setting(
        AUTO,
        "weight of the diversity loss (alpha): a number; or auto, which chooses the largest of 1, 0.3, 0.1, ... at "
        "which every member is as right about labels set aside as members trained without diversity, within a standard "
        "error, and members differ on at most half of the unlabelled states",
        source=f"{BEYOND}: docs/concepts.md",
        low=0.0,
        words=[AUTO],
    )
    schedule: str = setting(
        "sequential",
        "sequential: train one member after the other, each to differ from the earlier members; simultaneous: train "
        "all members at once (the double sum of Eq. (1))",
        source="D-BAT (arXiv:2202.04414); simultaneous: Eq. (1)",
        choices=SCHEDULES,
    )
    restarts: int = setting(
        4,
        "number of starts with different random numbers, each a first member if the schedule is sequential, or a whole "
        "ensemble if it is simultaneous; the start whose predictions tell most about unlabelled states is kept",
        source=f"{BEYOND}: docs/results/rooms.md",
        low=1,
        high=64,
    )
    share: float | Literal["auto", "labels"] = setting(
        AUTO,
        "share of positives among unlabelled states that divdis expects, or the smallest share that independent "
        "accepts; auto: the share that a member without diversity predicts, if the weight is auto or the schedule is "
        "sequential; labels: the share among the labelled states",
        source=f"labels: DivDis (arXiv:2202.03418); auto: {BEYOND}",
        low=0.0,
        high=1.0,
        words=[AUTO, LABELS],
    )
    sub_goals: tuple[str, ...] = setting((), "sub-goals to train, separated by commas; empty: all sub-goals")
    workers: int = setting(0, "number of processes that train; 0: one for each processor core", low=0, high=1024)

    def training(self, weight: float, share: float | Literal["labels"], **others: Any) -> EnsembleConfig:
        """Return the settings of one training with this weight and share. ``others`` replace the user's settings."""
        shared = self.model_dump(include={*MembersConfig.model_fields, "schedule"})
        chosen = {"diversity_weight": weight, "share": share}
        return EnsembleConfig(**shared | chosen | others)
