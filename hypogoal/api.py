"""The Python interface: run stages, load what was trained, predict, play options as actions of an environment.

The functions of the stages do what their commands do. ``arguments`` takes a command's options, ``preset``, ``seed``,
``device``, ``force``, ``resume``, ``quiet`` and, in training, ``tensorboard``, and any setting by name. What would end
a command is a ``UserError``.
"""

import contextlib
import os
from collections.abc import Callable, Iterable
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

from hypogoal import stages
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.processes import own_settings
from hypogoal.core.tensors import load_tensors
from hypogoal.core.terminal import say
from hypogoal.domains.base import BUILT_IN, REGISTERED, Domain, load_domain
from hypogoal.domains.gymnasium_domain import GymnasiumDomain
from hypogoal.hypotheses.ensemble import Ensemble, read_ensemble
from hypogoal.hypotheses.wrappers import SubgoalReward, ensemble_at
from hypogoal.look import describe, lines, outcome
from hypogoal.options.env import OptionEnv, Options
from hypogoal.options.learner import make_policies
from hypogoal.options.termination import rule_of, set_thresholds

__all__ = ["GymnasiumDomain", "OptionEnv", "SubgoalReward", "load_ensemble", "load_options"]
Place = str | os.PathLike[str]
OPTIONS = ("preset", "seed", "device", "force", "resume", "quiet", "tensorboard")  # arguments that are no settings


class Made:
    """A data file, an artefact or a run at ``path``. It works wherever a path is expected, and shows what it holds."""

    def __init__(self, path: Place):
        self.path = Path(path)

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def metrics(self) -> dict[str, Any]:
        """Its numbers: counts of states, a training's last log entry, or all of an evaluation or a comparison."""
        return dict(describe(self.path).get("numbers", {}))

    def __repr__(self) -> str:
        details = describe(self.path)
        return "\n".join([lines(details)[0], *outcome(details)])

    def _repr_html_(self) -> str:
        return f'<pre style="line-height: 1.2">{escape(repr(self))}</pre>'

    def show(self) -> None:
        """Print what ``hypogoal show`` prints: result, configuration, inputs."""
        for line in [*repr(self).splitlines(), *lines(describe(self.path))[1:]]:
            say(line)


def collect(domain: str | Domain, out: Place, **arguments: Any) -> Made:
    """Collect states into the HDF5 file ``out``. A domain object is known by its ``name``, in this process only."""
    if isinstance(domain, Domain):
        if domain.name in BUILT_IN and load_domain(domain.name) is not domain:
            raise UserError("this domain has the name of one of hypogoal's", domain.name, "Give it another name.")
        REGISTERED[domain.name] = domain
    return _made("collect", domain if isinstance(domain, str) else domain.name, out, arguments)


def train_ensemble(data: Place, out: Place, *, unlabelled: Iterable[Place] = (), **arguments: Any) -> Made:
    """Train an ensemble for each sub-goal of a data file, if wanted with ``unlabelled`` states from elsewhere."""
    return _made("train-ensemble", Path(data), out, arguments, unlabelled=[*map(Path, unlabelled)])


def train_options(ensemble: Place, out: Place, *, options: Place | None = None, **arguments: Any) -> Made:
    """Learn an option for every member of an ensemble, or continue training its ``options``."""
    return _made("train-options", Path(ensemble), out, arguments, options=Path(options) if options else None)


def train_meta(ensemble: Place, out: Place, *, options: Place | None = None, **arguments: Any) -> Made:
    """Learn from the reward which options to choose: fresh ones, or trained ``options``."""
    return _made("train-meta", Path(ensemble), out, arguments, options=Path(options) if options else None)


def evaluate(run: Place, out: Place | None = None, **arguments: Any) -> Made:
    """Compute every number of a run into ``run/evaluation`` or ``out``; takes ``layouts``, and no settings."""
    path, place = Path(run), Path(out or Path(run) / "evaluation")
    call = partial(stages.named("evaluate"), path, place, **arguments)
    return _called(place, call)


def compare(*runs: Place, out: Place, force: bool = False) -> Made:
    """Compare each evaluated run with the first. The result shows which wins, by how much, on what."""
    paths = [*map(Path, runs)]
    from hypogoal.tools.compare import compare as written

    call = partial(written, paths, Path(out), force=force)
    return _called(Path(out), call)


def _made(stage: str, source: str | Path, out: Place, arguments: dict[str, Any], **sources: Any) -> Made:
    settings = {name: value for name, value in arguments.items() if name not in OPTIONS}
    options = {name: value for name, value in arguments.items() if name in OPTIONS}
    run = partial(stages.make, stage, source, Path(out), settings, **sources, **options)
    return _called(Path(out), run)


def _called(out: Path, run: Callable[[], object]) -> Made:
    """Call a stage; with ``resume`` the result may be complete already."""
    with contextlib.suppress(Complete), own_settings():
        run()
    return Made(out)


@own_settings()
def load_ensemble(path: str | Path, sub_goal: str) -> Ensemble:
    """The hypotheses of one sub-goal.

    Args:
        path: an ensemble artefact's folder.
        sub_goal: for example ``open-red-door``.

    Returns:
        An ensemble; ``ensemble.predict(observations)`` takes (N, *obs_shape), uint8 or float32 as in training,
        and returns float32 (N, K).

    Raises:
        UserError: not an ensemble artefact, or no such sub-goal.

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
    """The options of an options or meta artefact: policies and termination classifiers.

    Args:
        path: the artefact's folder.
        ensemble: the ensemble artefact they were trained with; None: the one in the manifest.

    Raises:
        UserError: not such an artefact, the ensemble is gone, or the options end at the true sub-goals (oracle).

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
    rule_of(config["termination"])  # a rule of the user's own is refused where it is not allowed
    set_thresholds(ensembles, weights)
    return Options(
        goals,
        members,
        ensembles,
        policies,
        config["option_timeout"],
        config["mask_reached"],
        domain=config["domain"],
        domain_config=config["domain_config"],
    )
