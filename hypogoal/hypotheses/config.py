"""The settings of ensemble training, without PyTorch, so that ``hypogoal config`` starts fast."""

from typing import Any, Final, Literal

from pydantic import model_validator

from hypogoal.core.config import Config, setting

BEYOND = "own: beyond the paper"
FULL = "full"  # the view that shows all of an observation
VIEW = "view."  # before a setting of a view of one's own
AUTO: Final = "auto"  # a value that is chosen from the user's own states
SCHEDULES = ("simultaneous", "sequential")
LABELS: Final = "labels"  # the share of positives that the labelled states have


class MembersConfig(Config):
    """The members and their training but for the weight of diversity. The defaults are DoorKey's (Table 3)."""

    members: int = setting(3, "hypotheses per sub-goal (K); 1 is a single CNN", source="Table 3", low=1, high=64)
    diversity: str = setting(
        "dbat", "diversity objective: dbat, none, another of docs/concepts.md, or module:function", source="Eq. (1)"
    )
    teacher: str = setting(
        "",
        "own code, module:function, that gives scores of the unlabelled states, which members learn beside the labels; "
        "empty: none",
        source=f"{BEYOND}: docs/extending.md",
    )
    network: str = setting(
        "auto",
        "member network: doorkey, montezuma, tiles, mlp, or module:function; auto: of these in turn the first that "
        "takes the pictures, mlp for numbers; of cameras and numbers by key: front=tiles,state=mlp",
        source="the paper's appendix",
    )
    steps: int = setting(
        150,
        "gradient steps (for each member if sequential)",
        unit="batches",
        source="own choice, the paper has none: docs/results/hypotheses.md",
        low=1,
        high=10_000_000,
    )
    learning_rate: float = setting(2e-4, "Adam's learning rate", source="Table 3", low=0.0, high=1.0)
    l2_weight: float = setting(1e-4, "L2 regularisation, Adam's weight decay", source="Table 3", low=0.0, high=1.0)
    batch_size: int = setting(
        64,
        "labelled states in a batch, and as many unlabelled ones",
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
        "what members see of an observation: full, all of it; or a view of your own, module:Class",
        source=BEYOND,
    )
    view_settings: tuple[str, ...] = setting(
        (), "settings of a view of your own, KEY=VALUE: --set view.KEY=VALUE", source=BEYOND
    )
    threshold: str = setting(
        "0.5",
        "the probability above which a prediction is positive: a number; unlabelled-split, the cut that best splits "
        "the unlabelled states in two; or module:function",
        source=f"{BEYOND}; unlabelled-split: Otsu 1979",
    )

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, values: Any) -> Any:
        """Values of a view of one's own, ``view.KEY``, as ``view_settings``."""
        of_view = [name for name in values if name.startswith(VIEW)]
        if not of_view:
            return values
        others = {name: value for name, value in values.items() if name not in of_view}
        settings = [f"{name.removeprefix(VIEW)}={values[name]}" for name in of_view]
        return others | {"view_settings": settings}


class EnsembleConfig(MembersConfig):
    """One training of an ensemble, with the paper's weight and schedule by default."""

    diversity_weight: float = setting(1e-4, "weight of the diversity loss (alpha)", source="Table 3, Eq. (1)", low=0.0)
    schedule: str = setting("simultaneous", "all members at once, or one after the other", choices=SCHEDULES)
    share: float | Literal["labels"] = setting(
        LABELS, "share of positives that divdis and independent expect", low=0.0, high=1.0, words=[LABELS]
    )


class TrainEnsembleConfig(MembersConfig):
    """The settings of ``train-ensemble``: ensembles of some sub-goals."""

    diversity_weight: float | Literal["auto"] = setting(
        AUTO,
        "weight of the diversity loss (alpha); auto: the largest of 1, 0.3, 0.1, ... at which every member is as right "
        "about held-out labels as one trained without diversity, within a standard error, and members differ on at "
        "most half of the unlabelled states",
        source=f"{BEYOND}: docs/concepts.md",
        low=0.0,
        words=[AUTO],
    )
    schedule: str = setting(
        "sequential",
        "one member after the other, each against the earlier ones, or all at once (the double sum of Eq. (1))",
        source="D-BAT (arXiv:2202.04414); simultaneous: Eq. (1)",
        choices=SCHEDULES,
    )
    restarts: int = setting(
        4,
        "first members of a sequential ensemble that begin, or whole ensembles if simultaneous; the one stays that "
        "tells most about unlabelled states",
        source=f"{BEYOND}: docs/results/rooms.md",
        low=1,
        high=64,
    )
    share: float | Literal["auto", "labels"] = setting(
        AUTO,
        "share of positives among unlabelled states: what divdis expects, or the least that independent does; auto: "
        "what a member without diversity predicts, if the weight is auto or the schedule sequential; labels: that of "
        "the labelled states",
        source=f"labels: DivDis (arXiv:2202.03418); auto: {BEYOND}",
        low=0.0,
        high=1.0,
        words=[AUTO, LABELS],
    )
    sub_goals: tuple[str, ...] = setting((), "sub-goals to train, comma-separated; empty for all")
    workers: int = setting(0, "processes; 0 for one per core", low=0, high=1024)

    def training(self, weight: float, share: float | Literal["labels"], **others: Any) -> EnsembleConfig:
        """The settings of one training with this weight and share; ``others`` replace the user's."""
        shared = self.model_dump(include={*MembersConfig.model_fields, "schedule"})
        chosen = {"diversity_weight": weight, "share": share}
        return EnsembleConfig(**shared | chosen | others)
