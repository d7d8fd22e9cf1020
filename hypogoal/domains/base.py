"""The interface of a domain, and how to find one by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from hypogoal.core import own_code
from hypogoal.core.arrays import Bools, Bytes, Doubles, Floats, Ints
from hypogoal.core.checkpoints import Resumable, State
from hypogoal.core.config import C, Values, model_of, preset, resolve
from hypogoal.core.errors import UserError
from hypogoal.data import Collected
from hypogoal.observations import PICTURE, DType, Observations, Shape, Standard

if TYPE_CHECKING:
    import gymnasium

BUILT_IN = {
    "doorkey": "hypogoal.domains.doorkey.domain:DOMAIN",
    "montezuma": "hypogoal.domains.montezuma.domain:DOMAIN",
    "rooms": "hypogoal.domains.rooms.domain:DOMAIN",
}
ENTRY_POINTS = "hypogoal.domains"
REGISTERED: dict[str, Domain] = {}  # domains that the running program defined, by name
EQUATION_1 = {"schedule": "simultaneous", "restarts": 1, "share": "labels"}  # of train-ensemble, beside the weight
IMPORTED = "imported"  # the domain of states that 'hypogoal import' got without --domain


class Step(NamedTuple):
    """One step of all environments of an engine.

    Attributes:
        next_ids: int64 (E,), the states reached, before any automatic reset.
        rewards: float32 (E,).
        terminated: bool (E,), the task is over.
        truncated: bool (E,), the step limit ended the episode.
        succeeded: bool (E,), the episode is over and a success, where the domain defines success. None: an episode
            succeeds when it terminates with a sum of rewards above 0.
    """

    next_ids: Ints
    rewards: Floats
    terminated: Bools
    truncated: Bools
    succeeded: Bools | None = None


class Plan(NamedTuple):
    """The transitions between the states reachable from the start."""

    ids: Ints  # (N,), the states
    actions: Ints  # (A,), the actions considered
    following: Ints  # (N, A), the state after each action, one of ``ids``
    final: Bools  # (N,), the episode ends there, so nothing follows
    solved: Bools  # (N,), it ends there with the task solved


class Layouts(Resumable):
    """The layout each episode begins in: one of ``seeds``, drawn by ``rng`` for every episode; without ``rng``,
    environment e always begins in seed number e (modulo their count).

    Attributes:
        now: the layout seeds of the environments' current episodes.
    """

    CHANGING = ("rng", "now")

    def __init__(self, seeds: Sequence[int], rng: Generator | None = None):
        self.seeds, self.rng, self.many = tuple(seeds), rng, len(seeds) > 1
        self.now: list[int] = []

    def begin(self, number: int) -> int:
        """The layout seed of a new episode in environment ``number``."""
        place = number if self.rng is None else int(self.rng.integers(len(self.seeds)))
        seed = self.seeds[place % len(self.seeds)]
        self.now[number : number + 1] = [seed]  # environments begin in their order, so that the list grows
        return seed


class Engine(Resumable, ABC):
    """Many environments, of one layout or several, stepped together; every distinct state has an integer id.

    Required members come first, then optional ones with their defaults.

    Attributes:
        n_actions: primitive actions are 0 .. n_actions - 1.
        count: environments (E).
        observation_shape, observation_dtype: uint8 (H, W, C) for pictures, or float32 of any shape, or mixed.
        standard: mean and deviation with which agents standardise float32 observations; set in training.
        max_steps: steps after which an episode is truncated.
        ids: int64 (E,), the current state of each environment.
        elapsed: int64 (E,), steps since its episode began.
        memory: it can draw at least this many of the latest states, and forgets older frames. None: it can draw all.
        starts: its start states, with ids 0 .. S - 1, never forgotten; empty where all episodes begin alike.
        position_names: the columns of :meth:`positions`; empty if the agent's position is unknown.
        layouts: where episodes begin; None: all in one layout.
        restarts: whether it has :meth:`restart`, or what this needs.
        resumes: whether :meth:`snapshot` has all that the next steps need.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("ids", "elapsed", "layouts")

    n_actions: int
    count: int
    observation_shape: Shape
    observation_dtype: DType = PICTURE
    standard: Standard | None = None
    max_steps: int
    ids: Ints
    elapsed: Ints
    memory: int | None = None
    starts: Sequence[Any] = ()
    position_names: tuple[str, ...] = ()
    layouts: Layouts | None = None
    restarts = resumes = False

    @property
    @abstractmethod
    def n_states(self) -> int:
        """Ids assigned so far are 0 .. n_states - 1."""

    def reset(self) -> Ints:
        """Begin a new episode in every environment; returns the ids, int64 (E,). Uses ``restart`` by default."""
        self.ids = self.elapsed = np.zeros(self.count, int)
        self.restart(np.ones(self.count, bool))
        return self.ids.copy()

    @abstractmethod
    def step(self, actions: Ints) -> Step:
        """Step every environment with actions (E,); where an episode ends, ``ids`` becomes a start state."""

    @abstractmethod
    def images(self, ids: Ints) -> Observations:
        """Observations (n, *observation_shape), ``observation_dtype``, of known states, in an array of their own."""

    @abstractmethod
    def labels(self, ids: Ints) -> Bools:
        """True sub-goal predicates, bool (n, G): an oracle, for evaluation and the upper bound only."""

    def restart(self, where: Bools) -> None:
        """Begin a new episode in the environments ``where``, bool (E,); needs ``restarts``. Uses ``_begin`` by default.

        The arrays of before stay as they are.
        """
        [numbers] = where.nonzero()
        if not len(numbers):  # in most steps
            return
        self.ids = self.ids.copy()
        self.elapsed = np.where(where, 0, self.elapsed)
        for number in numbers.tolist():
            self.ids[number] = self._begin(number)

    def _begin(self, number: int) -> int:
        """Begin an episode in one environment; returns the start state."""
        raise NotImplementedError

    @property
    def oldest(self) -> int:
        """Ids below this one, except start states, are forgotten and can no longer be drawn."""
        return 0

    def remembers(self, ids: NDArray[np.integer]) -> Bools:
        """Whether these states (...,) can still be drawn."""
        return (ids >= self.oldest) | (ids < len(self.starts))

    def positions(self, ids: Ints) -> Ints:
        """The agent's positions, int64 (n, ``position_names``), also in forgotten states."""
        raise NotImplementedError

    @property
    def tiles(self) -> Bytes | None:
        """The picture of each cell code, uint8 (codes, height, width, C); None if pictures are not made of cells."""
        return None

    def codes(self, ids: Ints) -> Bytes:
        """The cell codes of states, uint8 (n, cells); needs ``tiles``."""
        raise NotImplementedError

    def reachable(self) -> Ints | None:
        """Ids of all reachable states, one for each distinct image; None if unknown."""
        return None

    def plan(self, starts: Ints | None = None) -> Plan | None:
        """The state each action leads to from each state that can be reached; None if unknown.

        From these ``starts``, ids (n,), or from where episodes begin.
        """
        return None

    def shortest_path(self) -> int | None:
        """The fewest primitive steps that solve the task; None if unknown."""
        return None

    def random_success(self, episodes: int, rng: Generator) -> float | None:
        """The share of episodes of uniform-random actions that solve the task; None if not measured."""
        return None


class TurnEngine(Engine):
    """An engine that steps its environments one after the other, and keeps what it saw in the newest states.

    Subclasses begin an episode and play a step. In plain Python, because NumPy's operations slow down an emulator's
    next frames, see ``montezuma.emulator``.

    Attributes:
        room: the number of states, besides start states, of which it keeps what it saw.
        width: of how many bytes the facts are that it keeps of every state.
    """

    restarts = resumes = True
    room: int
    width: int

    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}  # by state, in order
        self._facts = bytearray()

    @property
    def n_states(self) -> int:
        return len(self._facts) // self.width

    @property
    def oldest(self) -> int:
        return max(len(self.starts), self.n_states - self.room)

    @property
    def kept(self) -> list[int]:
        """The states of which it keeps what it saw, in order."""
        return [*range(len(self.starts)), *range(self.oldest, self.n_states)]

    def _add(self, seen: Any, facts: bytes) -> int:
        """Keep what was seen in a new state, and its facts; returns its id."""
        state = self.n_states
        self._seen[state] = seen
        self._facts += facts
        forgotten = state - self.room
        if forgotten >= len(self.starts):
            del self._seen[forgotten]
        return state

    def read_facts(self, ids: Ints | Sequence[int]) -> Bytes:
        """The facts of states, uint8 (n, ``width``), also of forgotten ones."""
        every = np.frombuffer(self._facts, np.uint8)
        return every.reshape(-1, self.width)[ids]

    def images(self, ids: Ints) -> Observations:
        """See ``Engine``; ``ValueError`` if a state is unknown or forgotten."""
        images = np.empty((len(ids), *self.observation_shape), self.observation_dtype)
        for row, state in enumerate(ids.tolist()):
            if state not in self._seen:
                raise ValueError(f"state {state} is unknown, or forgotten: the engine keeps the last {self.room}")
            images[row] = self._image(self._seen[state])
        return images

    def _image(self, seen: Any) -> Any:
        """The observation of what was seen."""
        return seen

    def snapshot(self) -> State:
        return super().snapshot() | {"facts": np.frombuffer(self._facts, np.uint8).copy()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self._facts = bytearray(snapshot["facts"].tobytes())

    @abstractmethod
    def _play(self, number: int, action: int, elapsed: int) -> tuple[Any, ...]:
        """Step ``elapsed`` of one environment's episode: what a :class:`Step` says of it."""

    def step(self, actions: Ints) -> Step:
        elapsed = [steps + 1 for steps in self.elapsed.tolist()]
        outcomes = []
        ids = []
        for number, action in enumerate(actions.tolist()):
            outcome = self._play(number, action, elapsed[number])
            outcomes.append(outcome)
            state, _reward, terminated, truncated, *_ = outcome
            if terminated or truncated:
                state, elapsed[number] = self._begin(number), 0
            ids.append(state)
        self.ids, self.elapsed = np.array(ids), np.array(elapsed)
        following, rewards, *others = map(np.array, zip(*outcomes, strict=True))
        return Step(following, rewards.astype(np.float32), *others)


class Domain(ABC, Generic[C]):
    """What hypogoal needs to know about a domain; :class:`hypogoal.GymnasiumDomain` makes one from an environment.

    ``hypogoal check`` tests it. Required members come first, then optional ones.

    Attributes:
        name: for messages.
        sub_goals: their names (G); ``collect`` may label some of them.
        config_class: the settings of ``collect``, a ``Config`` of ``core.config.setting`` fields.
        engine_settings: the names of the settings that define the world; later stages play with them too.
        defaults: by stage, settings that suit the domain; sources: by stage, where they come from, if known.
        env_id: the id of its registered Gymnasium environment, if any.
        starts: names of places where episodes begin; ``make_engine`` takes one as ``start``.
        many_layouts: ``make_engine`` also takes ``layouts``, the :class:`Layouts` to begin episodes in.
        measures: it has :meth:`distance_to`; near: the distance up to which a state counts as near a true sub-goal.
        pictures: it has :meth:`picture` and :meth:`pixel`.
    """

    name: str
    sub_goals: tuple[str, ...]
    config_class: type[C]
    engine_settings: tuple[str, ...] = ()
    defaults: Mapping[str, Values] = {}
    sources: Mapping[str, str] = {}
    env_id: str = ""
    starts: tuple[str, ...] = ()
    many_layouts = False
    measures = pictures = False
    near = 0

    @property
    @abstractmethod
    def observation_shape(self) -> Shape:
        """(H, W, C) for pictures, any shape for other observations."""

    @property
    def observation_dtype(self) -> DType:
        """uint8 for pictures, float32 for other observations."""
        return PICTURE

    @abstractmethod
    def collect(self, config: C, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and held-out states."""

    @abstractmethod
    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Engine:
        """An engine of ``count`` environments of one layout; ``arguments``: ``engine_settings`` and ``start``."""

    @property
    def has_env(self) -> bool:
        """Whether it has a Gymnasium environment."""
        return bool(self.env_id)

    def make_env(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """Its Gymnasium environment."""
        import gymnasium

        if not self.has_env:
            raise UserError("this domain has no Gymnasium environment", self.name, "Name an environment instead.")
        return gymnasium.make(self.env_id, **arguments)

    def world(self, config: Values) -> dict[str, Any]:
        """The engine settings among ``config``, the settings that states were collected with.

        ``config`` is that of a data file, or ``domain_config`` of an artefact. Missing settings are left to
        ``make_engine``; values that ``collect`` would refuse are a ``UserError``.
        """
        values = {name: config[name] for name in self.engine_settings if name in config}
        checked = resolve(self.config_class, values, stage="collect") if values else None
        return {name: getattr(checked, name) for name in values}

    def task(self, world: Values) -> str:
        """What is rewarded and what ends an episode, in a sentence or two for people.

        ``world``: as of :meth:`world`; settings that it lacks have their defaults.
        """
        return f"The reward and the end of an episode are those of the domain '{self.name}'."

    def distance_to(self, sub_goal: str, positions: Ints) -> Ints:
        """The distance from positions to the nearest place where a sub-goal holds, int (n,); needs ``measures``."""
        raise NotImplementedError

    def picture(self, room: int) -> Bytes:
        """A picture of a room, uint8 (height, width, 3); needs ``pictures``."""
        raise NotImplementedError

    def pixel(self, positions: Ints) -> Doubles:
        """The column and row of positions in that picture, (n, 2); needs ``pictures``."""
        raise NotImplementedError


def load_domain(name: str) -> Domain:
    """A domain by name: a built-in one, an installed entry point (group ``hypogoal.domains``) or ``module:object``.

    Code that the user did not allow (see :mod:`hypogoal.core.own_code`), or an object that is no domain, is a
    ``UserError``. What a domain of one's own has as defaults, such as a network, may be loaded with it.
    """
    name = "rooms" if name == "which-feature" else name  # so called in files of 0.23
    domain = REGISTERED.get(name)
    if domain is None and name == IMPORTED:
        raise UserError(
            "the domain of these imported states is not known",
            name,
            f"Import them again with --domain, one of {', '.join(BUILT_IN)} or module:object, and train on that file.",
        )
    domain = domain or own_code.load(name, "domain", ENTRY_POINTS, BUILT_IN)
    if not isinstance(domain, Domain):
        raise UserError("the object is not a domain", name, "Derive it from hypogoal.domains.base.Domain.")
    for settings in domain.defaults.values():
        own_code.allow(settings.values())
    return domain


def installed_domain(name: str) -> Domain | None:
    """The domain, or None if it is not installed: a user's data may name such a one. See :func:`load_domain`."""
    own_code.require_trust(name, "domain")
    try:
        return load_domain(name)
    except UserError:
        return None


def layers_of(stage: str, domain: str, preset_name: str | None) -> list[tuple[Values, str]]:
    """What replaces the defaults of a stage's settings, and its source: the domain's own, then a preset's."""
    installed = installed_domain(domain)
    layers = []
    if installed:
        layers.append((installed.defaults.get(stage, {}), installed.sources.get(stage, f"{domain}'s own")))
    return [*layers, (preset(preset_name, stage, domain), f"preset {preset_name}")]


def settings_of(
    kind: type[C],
    stage: str,
    domain: str,
    preset_name: str | None = None,
    typed: Values | None = None,
    *,
    inherited: Values | None = None,
) -> C:
    """The settings of a stage on a domain: its defaults, a preset's, those ``inherited``, then what the user typed.

    ``inherited`` are of the options that the stage continues. What is unknown or not allowed is a ``UserError``.
    """
    model = load_domain(domain).config_class if stage == "collect" else model_of(stage)
    layers = [values for values, _ in layers_of(stage, domain, preset_name)]
    settings = resolve(model, *layers, inherited or {}, typed or {}, stage=stage)
    assert isinstance(settings, kind)
    return settings
