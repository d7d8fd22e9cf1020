"""The Python interface: load what was trained, predict, and play options as actions of a Gymnasium environment."""

from pathlib import Path

import numpy as np

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.gymnasium_domain import GymnasiumDomain
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.hypotheses.wrappers import SubgoalReward, SubgoalTermination
from hypogoal.options.env import OptionEnv, Options
from hypogoal.options.initiation import NAME as INITIATION
from hypogoal.options.initiation import Narrowed
from hypogoal.options.policies import make_policies
from hypogoal.options.termination import Dwell, Patience, rule_of, thresholds_in

__all__ = ["GymnasiumDomain", "OptionEnv", "SubgoalReward", "SubgoalTermination", "load_ensemble", "load_options"]


def load_ensemble(path: str | Path, sub_goal: str) -> Ensemble:
    """The hypotheses of one sub-goal.

    Args:
        path: an ensemble artefact's folder.
        sub_goal: for example ``open-red-door``.

    Returns:
        An ensemble; ``ensemble.predict(observations)`` gives float32 (N, K) from (N, *obs_shape), uint8 or
        float32 as it was trained.

    Raises:
        UserError: not an ensemble artefact, or no such sub-goal.

    >>> import numpy, hypogoal
    >>> ensemble = hypogoal.load_ensemble("runs/demo/ensemble", "open-red-door")
    >>> observations = numpy.zeros((2, *ensemble.observation_shape), dtype="uint8")
    >>> ensemble.predict(observations).shape  # P(sub-goal reached) of each state, per member
    (2, 3)
    >>> ensemble.verdicts(observations).dtype
    dtype('bool')
    """
    artefact = open_artefact(Path(path), "ensemble").whole()
    return read_ensemble(artefact.path, artefact.config, sub_goal)


def load_options(path: str | Path, ensemble: str | Path | None = None) -> Options:
    """The options of an options or meta artefact: policies and termination classifiers.

    Args:
        path: the artefact's folder.
        ensemble: the ensemble artefact they were trained with; found from the manifest when None.

    Raises:
        UserError: not such an artefact, the ensemble is gone, or the options end at the true sub-goals (oracle).

    >>> import hypogoal
    >>> options = hypogoal.load_options("runs/demo/meta")
    >>> options.count, options.members, options.sub_goals[3], options.name(11)
    (15, 3, 'open-red-door', 'open-red-door/2')
    """
    artefact = open_artefact(Path(path), ("options", "meta")).whole()
    config = artefact.config
    folder = Path(ensemble) if ensemble else artefact.input("ensemble")
    source = open_artefact(folder, "ensemble").whole()
    ensembles = [read_ensemble(source.path, source.config, sub_goal) for sub_goal in config["sub_goals"]]
    weights = load_tensors(artefact.path / "options.safetensors")
    policies = make_policies(config, weights, source.config, ensembles[0])
    goals, members = tuple(config["sub_goals"]), config["members"]
    rule, length = rule_of(config["termination"])
    if rule is Patience:
        lowered = thresholds_in(weights, len(goals) * members).reshape(len(goals), members)
        for own, log_odds in zip(ensembles, lowered, strict=True):
            own.set_thresholds((1 / (1 + np.exp(-log_odds))).astype(np.float32))
    initiation = None
    if INITIATION in artefact.manifest["files"]:
        learned, shape = load_tensors(artefact.path / INITIATION), tuple(source.config["observation_shape"])
        initiation = Narrowed(learned, shape, len(goals) * members, config["initiation_threshold"])
    return Options(
        goals,
        members,
        ensembles,
        policies,
        config["option_timeout"],
        initiation,
        config["mask_reached"],
        domain=config["domain"],
        domain_config=config["domain_config"],
        dwell=length if rule is Dwell else 1,
    )
