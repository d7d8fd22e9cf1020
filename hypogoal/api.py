"""The functions of the Python interface that are no stages: compare runs, load ensembles and options.

The functions of the stages do what their commands do, see :mod:`hypogoal.command.stage`. They take ``out``, a command's
options (``preset``, ``seed``, ``device``, ``force``, ``resume``, ``quiet``, inputs such as ``options``) and any setting
by name. They raise ``UserError`` where a command would end with an error.
"""

from pathlib import Path

from hypogoal.command.call import Place
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.processes import own_settings
from hypogoal.core.tensors import load_tensors
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.look import Made
from hypogoal.options.env import Options
from hypogoal.options.learner import make_policies
from hypogoal.options.reward import ensemble_at
from hypogoal.options.termination import saved_rule


def compare(*runs: Place, out: Place, force: bool = False) -> Made:
    """Compare each evaluated run with the first. The result shows which run wins, by how much, on what."""
    from hypogoal.tools.compare import compare as compared

    return compared(runs, out, force=force)


@own_settings()
def load_ensemble(path: str | Path, sub_goal: str) -> Ensemble:
    """Return the hypotheses of one sub-goal.

    Args:
        path: an ensemble artefact's folder.
        sub_goal: for example ``open-red-door``.

    Returns:
        An ensemble; ``ensemble.predict(observations)`` takes (N, *obs_shape), uint8 or float32 as in training,
        and returns float32 (N, K).

    Raises:
        UserError: if ``path`` is no ensemble artefact, or has no such sub-goal.

    >>> import numpy, hypogoal
    >>> ensemble = hypogoal.load_ensemble("runs/demo/ensemble", "open-red-door")
    >>> observations = numpy.zeros((2, *ensemble.observation_shape), dtype="uint8")
    >>> ensemble.predict(observations).shape  # P(sub-goal reached) of each state, per member
    (2, 3)
    >>> ensemble.predictions(observations).dtype
    dtype('bool')
    """
    return ensemble_at(Path(path), sub_goal)


@own_settings()
def load_options(path: str | Path, ensemble: str | Path | None = None) -> Options:
    """Return the options of an options or meta artefact: policies and termination classifiers.

    Args:
        path: the artefact's folder.
        ensemble: the ensemble artefact with which the options were trained; None: the ensemble in the manifest.

    Raises:
        UserError: if ``path`` is no such artefact, if the ensemble is gone, or if the options end at the true sub-goals
            (oracle).

    >>> import hypogoal
    >>> options = hypogoal.load_options("runs/demo/meta")
    >>> options.count, options.members, options.sub_goals[3], options.name(11)
    (15, 3, 'open-red-door', 'open-red-door/2')
    """
    artefact = open_artefact(Path(path), "options", "meta")
    config = artefact.config
    folder = Path(ensemble) if ensemble else artefact.input("ensemble")
    source = open_artefact(folder, "ensemble")
    ensembles = [read_ensemble(source.path, source.config, sub_goal) for sub_goal in config["sub_goals"]]
    weights = load_tensors(artefact.path / "options.safetensors")
    policies = make_policies(config, weights, source.config)
    goals, members = tuple(config["sub_goals"]), config["members"]
    rule = saved_rule(config["termination"], weights, len(goals) * members)
    return Options(
        goals,
        members,
        ensembles,
        policies,
        rule,
        config["option_timeout"],
        config["mask_reached"],
        domain=config["domain"],
        domain_config=config["domain_config"],
    )
