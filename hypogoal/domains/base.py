"""The interface of a domain and of its engines. ``domains.find`` finds a domain by its name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from hypogoal.core.arrays import Bools, Bytes, Doubles, Floats, Ints
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.config import C, Values, resolve
from hypogoal.core.errors import UserError
from hypogoal.data import Collected
from hypogoal.observations import PICTURE, DType, Observations, Shape, Standard

if TYPE_CHECKING:
    import gymnasium

EQUATION_1 = {"schedule": "simultaneous", "restarts": 1, "share": "labels"}  # for train-ensemble, beside the weight


class Step(NamedTuple):
    """One step of all environments of an engine.

    Attributes:
        next_ids: int64 (E,), the states reached, before any automatic reset.
        rewards: float32 (E,).
        terminated: bool (E,), whether the task is over.
        truncated: bool (E,), whether the step limit ended the episode.
        succeeded: bool (E,), whether the episode is over and a success, if the domain defines success. None: an episode
            succeeds if it terminates with a sum of rewards above 0.
    """

    next_ids: Ints
    rewards: Floats
    terminated: Bools
    truncated: Bools
    succeeded: Bools | None = None


class Plan(NamedTuple):
    """The transitions between the states that can be reached from the start."""

    ids: Ints  # (N,), the states
    actions: Ints  # (A,), the actions considered
    following: Ints  # (N, A), the state after each action, one of ``ids``
    final: Bools  # (N,), whether the episode ends in the state
    solved: Bools  # (N,), whether the episode ends in the state with the task solved


class Layouts(Resumable):
    """The layouts in which episodes begin.

    For every episode ``rng`` draws one of ``seeds``. Without ``rng``, environment e always begins in seed number e,
    modulo the number of seeds.

    Attributes:
        now: the layout seeds of the environments' current episodes.
    """

    CHANGING = ("rng", "now")

    def __init__(self, seeds: Sequence[int], rng: Generator | None = None):
        self.seeds, self.rng, self.many = tuple(seeds), rng, len(seeds) > 1
        self.now: list[int] = []

    def begin(self, number: int) -> int:
        """Begin an episode in environment ``number``. Return the episode's layout seed."""
        place = number if self.rng is None else int(self.rng.integers(len(self.seeds)))
        seed = self.seeds[place % len(self.seeds)]
        self.now[number : number + 1] = [seed]  # the list grows, because environments first begin in their order
        return seed


class Engine(Resumable, ABC):
    """Many environments, of one layout or several, that are stepped together. Every distinct state has an integer id.

    Required members come first, then optional members with their defaults.

    Attributes:
        n_actions: the number of primitive actions, which are 0 .. n_actions - 1.
        count: the number of environments (E).
        observation_shape, observation_dtype: uint8 (H, W, C) for pictures, or float32 of any shape, or mixed.
        standard: mean and deviation with which agents standardise float32 observations. Training sets them.
        max_steps: the number of steps after which an episode is truncated.
        ids: int64 (E,), the current state of each environment.
        elapsed: int64 (E,), the number of steps since the environment's episode began.
        memory: the number of latest states that can at least be drawn. Frames of older states are forgotten. None: all
            states can be drawn.
        starts: the start states, with ids 0 .. S - 1, which are never forgotten. Empty: all episodes begin alike.
        position_names: the names of the columns of :meth:`positions`. Empty: the agent's position is unknown.
        layouts: the layouts in which episodes begin. None: all episodes begin in one layout.
        restarts: whether :meth:`restart` works, because the engine defines it or ``_begin``.
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
        """The number of ids assigned so far, which are 0 .. n_states - 1."""

    def reset(self) -> Ints:
        """Begin a new episode in every environment. Return the ids, int64 (E,). By default this uses ``restart``."""
        self.ids = self.elapsed = np.zeros(self.count, int)
        self.restart(np.ones(self.count, bool))
        return self.ids.copy()

    @abstractmethod
    def step(self, actions: Ints) -> Step:
        """Step every environment with actions (E,). Where an episode ends, ``ids`` becomes a start state."""

    @abstractmethod
    def images(self, ids: Ints) -> Observations:
        """Return the observations of known states, ``observation_dtype`` (n, *observation_shape), in a new array."""

    @abstractmethod
    def labels(self, ids: Ints) -> Bools:
        """Return whether each sub-goal truly holds in states, bool (n, G), for evaluation and the upper bound only."""

    def restart(self, where: Bools) -> None:
        """Begin a new episode in the environments ``where``, bool (E,). By default this uses ``_begin``.

        The engine must have ``restarts``. ``ids`` and ``elapsed`` become new arrays, so the old arrays do not change.
        """
        [numbers] = where.nonzero()
        if not len(numbers):  # as in most steps
            return
        self.ids = self.ids.copy()
        self.elapsed = np.where(where, 0, self.elapsed)
        for number in numbers.tolist():
            self.ids[number] = self._begin(number)

    def _begin(self, number: int) -> int:
        """Begin an episode in one environment. Return the start state."""
        raise NotImplementedError

    @property
    def oldest(self) -> int:
        """The id below which states, except start states, are forgotten and can no longer be drawn."""
        return 0

    def remembers(self, ids: NDArray[np.integer]) -> Bools:
        """Return whether states (...,) can still be drawn, bool (...,)."""
        return (ids >= self.oldest) | (ids < len(self.starts))

    def positions(self, ids: Ints) -> Ints:
        """Return the agent's positions in states, int64 (n, ``position_names``), also in forgotten states."""
        raise NotImplementedError

    @property
    def tiles(self) -> Bytes | None:
        """The picture of each cell code, uint8 (codes, height, width, C), or None if pictures are not made of cells."""
        return None

    def codes(self, ids: Ints) -> Bytes:
        """Return the cell codes of states, uint8 (n, cells). The engine must have ``tiles``."""
        raise NotImplementedError

    def reachable(self) -> Ints | None:
        """Return the ids of all reachable states, one for each distinct image, or None if they are unknown."""
        return None

    def plan(self, starts: Ints | None = None) -> Plan | None:
        """Return where each action leads from each state that can be reached, or None if that is unknown.

        The states are those that can be reached from ``starts``, ids (n,), or from where episodes begin.
        """
        return None

    def shortest_path(self) -> int | None:
        """Return the fewest primitive steps that solve the task, or None if the number is unknown."""
        return None

    def random_success(self, episodes: int, rng: Generator) -> float | None:
        """Return the share of episodes of uniformly random actions that solve the task, or None if not measured."""
        return None


class Domain(ABC, Generic[C]):
    """All that hypogoal needs to know about a domain.

    :class:`hypogoal.GymnasiumDomain` makes a domain of an environment, and ``hypogoal check`` tests a domain. Required
    members come first, then optional members.

    Attributes:
        name: the domain's name in messages.
        sub_goals: the names of the sub-goals (G). ``collect`` may label some of them.
        config_class: the settings of ``collect``, a ``Config`` of ``core.config.setting`` fields.
        engine_settings: the names of the settings that define the world. Later stages play with these settings, too.
        defaults: by stage, settings that suit the domain.
        sources: by stage, where the ``defaults`` come from, if that is known.
        env_id: the id of the domain's registered Gymnasium environment, if any.
        starts: the names of places where episodes begin. ``make_engine`` takes a name as ``start``.
        many_layouts: whether ``make_engine`` also takes ``layouts``, the :class:`Layouts` to begin episodes in.
        measures: whether the domain has :meth:`distance_to`.
        near: the distance up to which a state counts as near a true sub-goal.
        pictures: whether the domain has :meth:`picture` and :meth:`pixel`.
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
        """The shape of an observation, (H, W, C) for pictures, and any shape for other observations."""

    @property
    def observation_dtype(self) -> DType:
        """The type of an observation, uint8 for pictures, float32 for numbers, or a structured type if mixed."""
        return PICTURE

    @abstractmethod
    def collect(self, config: C, seed: int, progress: Any) -> Collected:
        """Collect labelled, unlabelled and held-out states."""

    @abstractmethod
    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Engine:
        """Return an engine of ``count`` environments of one layout.

        ``arguments`` are settings among ``engine_settings``, and ``start``.
        """

    @property
    def has_env(self) -> bool:
        """Whether the domain has a Gymnasium environment."""
        return bool(self.env_id)

    def make_env(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        """Return the domain's Gymnasium environment. Raises ``UserError`` if there is none."""
        import gymnasium

        if not self.has_env:
            raise UserError("this domain has no Gymnasium environment", self.name, "Name an environment instead.")
        return gymnasium.make(self.env_id, **arguments)

    def world(self, config: Values) -> dict[str, Any]:
        """Return the engine settings among ``config``, the settings with which states were collected.

        ``config`` is that of a data file, or ``domain_config`` of an artefact. Missing settings are left to
        ``make_engine``. Raises ``UserError`` if ``collect`` would refuse a value.
        """
        values = {name: config[name] for name in self.engine_settings if name in config}
        checked = resolve(self.config_class, values, stage="collect") if values else None
        return {name: getattr(checked, name) for name in values}

    def task(self, world: Values) -> str:
        """Say in a sentence or two, for people, what is rewarded and what ends an episode.

        ``world`` is what :meth:`world` returns. Missing settings have their defaults.
        """
        return f"The reward and the end of an episode are those of the domain '{self.name}'."

    def distance_to(self, sub_goal: str, positions: Ints) -> Ints:
        """Return the distance from positions to the nearest place where a sub-goal holds, int (n,).

        The domain must have ``measures``, and ``sub_goal`` is one of its ``sub_goals``.
        """
        raise NotImplementedError

    def picture(self, room: int) -> Bytes:
        """Return a picture of a room, uint8 (height, width, 3). The domain must have ``pictures``."""
        raise NotImplementedError

    def pixel(self, positions: Ints) -> Doubles:
        """Return the column and row of positions in the room's picture, (n, 2). The domain must have ``pictures``."""
        raise NotImplementedError
