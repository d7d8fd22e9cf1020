"""Options set up in a domain and trained for a number of steps: what ``train-options`` and ``train-meta`` share."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, sha256_of
from hypogoal.core.checkpoints import Checkpoints
from hypogoal.core.config import assigned
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog, Progress
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.domains.base import Domain, Engine, Layouts, require_one_kind
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.meta.config import GAMMA, MetaConfig, PlayConfig, PracticeConfig, TrainMetaConfig, layout_seeds
from hypogoal.observations import PICTURE, Standard, standard_of
from hypogoal.options import choosers
from hypogoal.options.config import STACK
from hypogoal.options.learner import load_learner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.parts import Part
from hypogoal.options.recording import Recorder
from hypogoal.options.termination import ORACLE, Terminations, learned_terminations, oracle_terminations, rule_of
from hypogoal.options.visited import Visited

LOG_INTERVAL = 2_000  # environment steps
ONE_LAYOUT = "an engine of this domain plays one layout"


def assemble(
    domain: Domain,
    ensemble: Path,
    ensemble_config: Mapping[str, Any],
    config: PracticeConfig | TrainMetaConfig,
    seed: int,
    device: str = "cpu",
    ends: Callable[[Engine], Terminations] | None = None,
    standard: Standard | None = None,
    layouts: Layouts | None = None,
) -> OptionLoop:
    """Environments, an ensemble's options in them, fresh policies of these and over these.

    ``ensemble_config`` is that of the ensemble's manifest; ``seed`` is of weights, exploration, choices and, where
    there are several, layouts and start states. ``ends`` gives other terminations than the ensemble's, ``standard``
    goes with them; ``layouts`` replace those of ``config``. What does not go together is a ``UserError``.
    """
    learner, chooser = load_learner(config.network), choosers.load_chooser(config.chooser)
    if config.termination == ORACLE:
        columns_of(domain, ensemble_config["sub_goals"])
    world = domain.world(played_world(domain, ensemble_config["domain_config"], config.world))
    world |= start_arguments(domain, config, options_of(ensemble_config, config), seed)
    world |= {"layouts": layouts} if layouts else {}
    engine = domain.make_engine(config.layout_seed, config.environments, config.max_episode_steps, **world)
    cut(engine, config.cap)
    rules = [] if config.termination == ORACLE else [rule_of(config.termination)[0]]
    parts: list[type[Part]] = [learner, chooser, *rules]
    require_one_kind(engine)
    for part in parts:
        part.refuse(config, engine)
    if engine.observation_dtype != PICTURE:
        if not ends:
            first = ensemble_config["sub_goals"][0]
            standard = read_ensemble(ensemble, dict(ensemble_config), first).view.standard
        engine.standard = standard or standard_of(engine.observation_shape)
    terminations = ends(engine) if ends else terminations_for(domain, engine, ensemble, ensemble_config, config, device)
    options = terminations.options
    loop = OptionLoop(
        engine,
        terminations,
        learner(engine, terminations, config, seed, device),
        chooser.create(engine, options, config, seed, device),
        Recorder(options, engine),
        config,
        GAMMA if isinstance(config, TrainMetaConfig) else 1.0,
        visited=Visited(engine, config.save_visited, config.layout_seed, seed) if config.save_visited else None,
    )
    _check_labels(engine, domain)
    if near := nearness(domain, engine, ensemble_config, config):
        near(np.repeat(engine.ids[:1], options), np.arange(options))  # so that a user's labels fail before training
    return loop


def _check_labels(engine: Engine, domain: Domain) -> None:
    """Refuse (``UserError``) labels of another form than bool (n, G), before any training."""
    labels = engine.labels(engine.ids[:1])
    shape = (1, len(domain.sub_goals))
    if labels.shape != shape or labels.dtype != np.bool_:
        fault = f"the engine's labels of one state are {labels.dtype} {labels.shape}, not bool {shape}"
        raise UserError(fault, type(engine).__name__, "Give a truth value for each state and sub-goal.")


def terminations_for(
    domain: Domain, engine: Engine, ensemble: Path, ensemble_config: Mapping[str, Any], config: PlayConfig, device: str
) -> Terminations:
    """Those that the setting ``termination`` names: of an ensemble's members, or of the true sub-goals."""
    if config.termination == ORACLE:
        return oracle_terminations(engine, columns_of(domain, ensemble_config["sub_goals"]))
    running_only = config.experience == "own" and not config.mask_reached
    return judged(engine, ensemble, ensemble_config, device, running_only=running_only, rule=config.termination)


def judged(engine: Engine, ensemble: Path, ensemble_config: Mapping[str, Any], device: str, **how: Any) -> Terminations:
    """An ensemble's ``learned_terminations``; all states that can be reached are classified at once."""
    ensembles = [
        read_ensemble(ensemble, dict(ensemble_config), sub_goal).to(device) for sub_goal in ensemble_config["sub_goals"]
    ]
    terminations = learned_terminations(engine, ensembles, **how)
    many = engine.layouts is not None and engine.layouts.many
    if not many and (reachable := engine.reachable()) is not None:
        terminations.of(reachable)
    return terminations


def nearness(
    domain: Domain, engine: Engine, ensemble_config: Mapping[str, Any], config: PlayConfig
) -> Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.bool_]] | None:
    """Spec H5: a function of states (n,) and options (n,): whether these options' true sub-goals hold, or nearly.

    None where the domain lacks a sub-goal of the ensemble, or options end at true sub-goals.
    """
    sub_goals = ensemble_config["sub_goals"]
    if config.termination == ORACLE or not set(sub_goals) <= set(domain.sub_goals):
        return None
    columns = np.repeat(columns_of(domain, sub_goals), ensemble_config["members"])
    away = distances_of(domain, sub_goals, ensemble_config["members"])

    def near(ids: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.bool_]:
        holds = engine.labels(ids)[np.arange(len(ids)), columns[options]]
        if not (domain.measures and engine.position_names):
            return holds
        return holds | (away(engine.positions(ids), options) <= domain.near)

    return near


def distances_of(
    domain: Domain, sub_goals: Sequence[str], members: int
) -> Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64]]:
    """A function of positions (n, P) and options (n,): each one's distance to its option's true sub-goal, (n,)."""

    def away(positions: NDArray[np.int64], options: NDArray[np.int64]) -> NDArray[np.int64]:
        distances = np.zeros(len(options), np.int64)
        for number, sub_goal in enumerate(sub_goals):
            of_goal = options // members == number
            distances[of_goal] = domain.distance_to(sub_goal, positions[of_goal])
        return distances

    return away


def cut(engine: Engine, cap: float) -> None:
    """End episodes after ``cap`` times the layout's shortest path; 0 leaves them as long as they are."""
    if cap:
        if (shortest := engine.shortest_path()) is None:
            raise UserError("this layout's shortest path is not known", f"cap={cap:g}", "Give cap=0.")
        engine.max_steps = math.ceil(round(cap * shortest, 9))  # 1.1 * 50 is 55


def played_world(domain: Domain, collected: Mapping[str, Any], changes: Sequence[str]) -> dict[str, Any]:
    """The domain's settings with which states were collected, after ``changes``, the setting ``world``."""
    changed = assigned(changes)
    for name in changed:
        if name not in domain.engine_settings:
            names = ", ".join(domain.engine_settings) or "none"
            raise UserError(f"the world of {domain.name} has no such setting", f"world={name}", f"It has {names}.")
    return {**collected, **domain.world(changed)}


def columns_of(domain: Domain, sub_goals: Sequence[str], do: str = "Leave termination=oracle out.") -> list[int]:
    """The columns of these sub-goals among the domain's; a ``UserError`` that says ``do`` where it lacks one."""
    for sub_goal in sub_goals:
        if sub_goal not in domain.sub_goals:
            fault, names = f"{domain.name} does not know where this sub-goal holds", ", ".join(domain.sub_goals)
            raise UserError(fault, sub_goal, f"It knows of {names}. {do}")
    return [domain.sub_goals.index(sub_goal) for sub_goal in sub_goals]


def start_arguments(domain: Domain, config: PlayConfig, options: int, seed: int) -> dict[str, Any]:
    """Spec D4, H6: an engine's arguments: where episodes begin; none where nothing is chosen.

    An unknown start, no start where the domain has several, or layouts where it has one is a ``UserError``.
    """
    more: dict[str, Any] = {}
    if config.layouts.strip():
        if not domain.many_layouts:
            raise UserError(ONE_LAYOUT, f"{domain.name}, layouts={config.layouts}", "Leave it out.")
        seeds = layout_seeds(config.layouts, config.layout_seed)
        more["layouts"] = Layouts(seeds, rng_for(seed, "layouts") if len(seeds) > 1 else None)
    if not domain.starts:
        if config.start:
            raise UserError(f"{domain.name} has no named starts", f"start={config.start}", "Leave it out.")
        return more
    check_start(domain, config.start)
    memory = frames_kept(config, options)
    return {"start": config.start, "memory": memory, "seed": seed, **more}


def check_start(domain: Domain, starts: str) -> None:
    """Refuse (``UserError``) a start that the domain does not name."""
    for start in starts.split(",") if domain.many_starts else [starts]:
        if start not in domain.starts:
            fault = "unknown start" if start else "where are episodes to begin?"
            raise UserError(fault, start or "start", f"Give --set start=X, X one of {', '.join(domain.starts)}.")


def frames_kept(config: PlayConfig, options: int) -> int:
    """How many states back an engine must remember: those in replays and in the meta-policy's decisions."""
    decisions = config.decisions if isinstance(config, MetaConfig) else 0
    steps = (decisions + config.environments) * config.option_timeout + STACK * config.environments if decisions else 0
    return max(load_learner(config.network).reach(config, options), steps)


def train(
    loop: OptionLoop, steps: int, log: MetricsLog, progress: Progress, checkpoints: Checkpoints, until: float = 0.0
) -> bool:
    """Step ``loop`` for ``steps`` more environment steps, logging every ``LOG_INTERVAL`` steps.

    It ends earlier once a share ``until`` of the last episodes has succeeded (0: never); returns whether it has.
    ``loop`` is at the beginning of these ``steps``; from there it goes on to the last checkpoint, if there is one
    (Spec G1). An engine that cannot be resumed gets none.
    """
    recorder = loop.recorder
    end = recorder.steps + steps
    logged = begin = recorder.steps
    numbers: dict[str, float] = {}
    if not loop.engine.resumes:
        checkpoints = Checkpoints(None)

    def state() -> dict[str, Any]:
        return {"loop": loop.snapshot(), "log": log.snapshot(), "logged": logged, "numbers": numbers}

    saved = checkpoints.load()
    log.restore(saved["log"] if saved else 0)
    if saved:
        loop.restore(saved["loop"])
        logged, numbers = saved["logged"], saved["numbers"]
        progress.resume(recorder.steps - begin)
    solved = recorder.episodes.solved(until)
    with checkpoints:
        while recorder.steps < end and not solved:
            numbers |= loop.step()
            solved = recorder.episodes.solved(until)
            if recorder.steps - logged >= LOG_INTERVAL or recorder.steps >= end or solved:
                logged = recorder.steps
                shown = recorder.recent(restarted=loop.config.restart_options)
                log.write(
                    step=recorder.steps,
                    episodes=len(recorder.episodes),
                    states=loop.engine.n_states,
                    **shown,
                    **numbers,
                    **({"until_reached": solved} if until else {}),
                )
                progress.update(min(recorder.steps - begin, steps), **shown)
            else:
                progress.update(recorder.steps - begin)
            checkpoints.offer(state)
    return solved


def check_fit(
    trained: Artefact, source: Artefact, config: PracticeConfig | TrainMetaConfig, fixed: Sequence[str]
) -> None:
    """Refuse (``UserError``) to train options further that are of another ensemble or differ in ``fixed`` settings."""
    made_from = [entry.sha256 for entry in trained.manifest.inputs if entry.kind == "ensemble"]
    if sha256_of(source.path) not in made_from:
        fault = "these options were trained with another ensemble"
        raise UserError(fault, trained.path, f"Train them from {source.path}.")
    before = trained.config
    for key in fixed:
        if key == "layout_seed" and before["layouts"]:  # options of many layouts may be played in any
            continue
        if before.get(key) != getattr(config, key, before.get(key)):  # a part's, where the network has that part
            fault = f"these options were trained with {key}={before[key]}, not {getattr(config, key)}"
            raise UserError(fault, trained.path, f"Give --set {key}={before[key]}, or leave it out.")


def inherited(trained: Artefact | None, fixed: Sequence[str]) -> dict[str, Any]:
    """The settings of trained options that hold where they are continued; of many layouts, any may be played."""
    if trained is None:
        return {}
    anywhere = bool(trained.config["layouts"])
    hold = [name for name in fixed if name in trained.config and (name != "layout_seed" or not anywhere)]
    return {name: trained.config[name] for name in hold}


def options_of(ensemble_config: Mapping[str, Any], config: PlayConfig) -> int:
    """How many options an ensemble's sub-goals have: one for each member, or for each truth."""
    return len(ensemble_config["sub_goals"]) * (1 if config.termination == ORACLE else ensemble_config["members"])


def continue_with(loop: OptionLoop, trained: Artefact) -> None:
    """Go on with the options of an artefact; replays start empty."""
    weights = load_tensors(trained.path / "options.safetensors")
    loop.learner.load(weights)
    loop.terminations.load(weights)


def description(domain: Domain, ensemble_config: Mapping[str, Any], config: PlayConfig, **more: Any) -> dict[str, Any]:
    """An artefact's configuration: the stage's, what it takes from its ensemble's, and ``more``."""
    return config.model_dump(mode="json") | {
        "sub_goals": ensemble_config["sub_goals"],
        "members": options_of(ensemble_config, config) // len(ensemble_config["sub_goals"]),
        "domain": ensemble_config["domain"],
        "domain_config": played_world(domain, ensemble_config["domain_config"], config.world),
        **more,
        "setting": config.network,
    }


def write_trained(
    folder: Path, loop: OptionLoop, domain: Domain, ensemble_config: Mapping[str, Any], config: PlayConfig, seed: int
) -> None:
    """Write what was learned, and what happened meanwhile, into an artefact's folder."""
    loop.recorder.write(folder)
    if near := nearness(domain, loop.engine, ensemble_config, config):
        loop.recorder.write_exploits(folder, near, loop.terminations.log_odds)
    if loop.visited:
        loop.visited.write(folder, domain, ensemble_config, seed)
    save_tensors(folder / "options.safetensors", loop.learner.state() | loop.terminations.state())
    if weights := loop.chooser.state():
        save_tensors(folder / choosers.FILE, weights)
    places = {"start": config.start, "layouts": config.layouts.strip()}
    if places["layouts"].isdecimal():
        seeds = layout_seeds(config.layouts, config.layout_seed)
        places["layouts"] = f"{seeds[0]}-{seeds[-1]}"
    places = {name: place for name, place in places.items() if place}
    write_layout(folder, loop.engine, config.layout_seed, config.random_episodes, seed, **places)


def write_layout(folder: Path, engine: Engine, layout_seed: int, episodes: int, seed: int, **places: str) -> None:
    """Spec F5: ``layout.json``, how hard the layout is: its shortest path, how often random play reaches the goal.

    Both are null where the engine does not know them; then no episode of random play is played. ``places`` are written
    first, last the step at which each room was first reached, where there are rooms.
    """
    success = engine.random_success(episodes, rng_for(seed, "random-play")) if episodes else None
    facts: dict[str, Any] = {
        **places,
        "layout_seed": layout_seed,
        "shortest_path": engine.shortest_path(),
        "random_success": success,
        "random_episodes": 0 if success is None else episodes,
    }
    if "room" in engine.position_names:
        positions = engine.positions(np.arange(engine.n_states))
        rooms, first = np.unique(positions[:, engine.position_names.index("room")], return_index=True)
        steps = np.maximum(first - len(engine.starts) + 1, 0)
        facts["rooms"] = dict(zip(map(str, rooms.tolist()), steps.tolist(), strict=True))
    (folder / "layout.json").write_text(json.dumps(facts) + "\n", encoding="utf-8")
