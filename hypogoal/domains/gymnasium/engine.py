"""Any Gymnasium environment as an engine: many copies stepped in turn, states by id, each distinct one kept once."""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hypogoal.core.checkpoints import ANEW
from hypogoal.core.errors import UserError
from hypogoal.domains.base import Layouts, Step, TurnEngine
from hypogoal.domains.observations import CLEARLY, Reading, reading_of, resized_picture
from hypogoal.observations import NUMBERS, PICTURE, Observations, digest, mixed_type

MakeEnv = Callable[..., gymnasium.Env]
Label = Callable[[gymnasium.Env], bool]
LabelAll = Callable[[gymnasium.Env], Mapping[str, bool]]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
MEMORY = 110_000  # the replay's 1e5 transitions and those not yet in it


def make_checked(make: MakeEnv) -> gymnasium.Env:
    """An environment with readable observations and ``Discrete`` actions; else a ``UserError``."""
    env: Any = make()
    if not isinstance(env, gymnasium.Env):
        do = "Give a function that returns a gymnasium.Env."
        raise UserError("the environment is none of Gymnasium's", type(env).__name__, do)
    reader_of(env)
    actions = env.action_space
    if not isinstance(actions, spaces.Discrete) or actions.start != 0:
        raise UserError("actions must be Discrete(n), from 0", actions, "Wrap it so that they are.")
    return env


class Reader(NamedTuple):
    """Reads observations of a space as arrays of one shape and type, see ``dataset.Observations``.

    ``features`` names the numbers of a non-image observation; ``key`` is that of the only entry of a dictionary, a
    picture. ``parts`` read the entries of a dictionary with pictures and others, by key. ``doubt`` is a warning that
    numbers may be meant as a picture.
    """

    space: spaces.Space[Any]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    features: tuple[str, ...] = ()
    key: str = ""
    doubt: str = ""
    parts: tuple[tuple[str, Any], ...] = ()  # each with its Reader

    def read(self, observation: Any) -> Any:
        """A copy (*shape) of an observation; ``UserError`` if it does not fit its space."""
        if self.parts:
            mixed = np.empty((), self.dtype)
            for key, part in self.parts:
                mixed[key] = part.read(observation[key])
            return mixed
        if self.key:
            observation = observation[self.key]
        elif not isinstance(self.space, spaces.Box):
            observation = spaces.flatten(self.space, observation)
        values = np.array(observation, order="C")
        received = f"{values.dtype} {values.shape}"
        if self.dtype == NUMBERS and values.dtype.kind in "iufb":
            values = values.astype(NUMBERS)
        if values.dtype != self.dtype or values.shape not in (self.shape, self.space.shape):
            do = f"Make the observation space and the observations agree; the space says {self.dtype} {self.shape}."
            raise UserError("the environment gave an observation that does not fit its space", received, do)
        return values.reshape(self.shape)

    def check(self, observation: Any) -> None:
        """Refuse (``UserError``) an observation that does not fit its space, or is not finite: see :class:`Starts`."""
        values = self.read(observation)
        numbers = [values[key] for key, part in self.parts if part.dtype == NUMBERS]
        if self.dtype == NUMBERS:
            numbers.append(values)
        if not all(np.isfinite(part).all() for part in numbers):
            raise UserError("the environment gave an observation that is not finite", values, "Give finite numbers.")


def reader_of(env: gymnasium.Env) -> Reader:
    """A reader of an environment's observations; a ``UserError`` if they are neither pictures nor numbers.

    Pictures are a ``Box`` of uint8 (H, W, C) or (H, W), or a ``Dict`` of just that. Any other ``Box`` is float32, see
    ``hypogoal.domains.observations``. Other spaces that Gymnasium's ``flatten`` accepts, such as dictionaries, become
    float32 (D,) in its order. A ``Dict`` with pictures and others, each under a key of its own, is mixed.
    """
    return _reader(env.observation_space)


def _reading(space: spaces.Box) -> Reading:
    return reading_of(space.shape, space.dtype)


def _is_picture(space: spaces.Space[Any]) -> bool:
    """Whether this is a picture, or refused because it may be."""
    return isinstance(space, spaces.Box) and (_reading(space).dtype == PICTURE or bool(_reading(space).fault))


def _reader(space: spaces.Space[Any], key: str = "") -> Reader:
    """A reader of a space, or of a dictionary's entry ``key``."""
    if isinstance(space, spaces.Dict) and len(space.spaces) > 1 and any(map(_is_picture, space.spaces.values())):
        entries = {name: _reader(part, str(name)) for name, part in space.spaces.items()}
        try:
            dtype = mixed_type({name: (entry.dtype, entry.shape) for name, entry in entries.items()})
        except (ValueError, KeyError, TypeError):
            do = "Give a Dict of pictures and numbers, with keys that can be file names."
            raise UserError("the entries of the observations cannot be read by their keys", space, do) from None
        doubts = (entry.doubt for entry in entries.values() if entry.doubt)
        return Reader(space, (), dtype, doubt=next(doubts, ""), parts=tuple(entries.items()))
    parts, doubt = list(_parts(space)), ""
    for name, part in parts:
        if not isinstance(part, spaces.Box):
            continue
        reading = _reading(part)
        if reading.dtype == PICTURE or reading.fault:
            if len(parts) > 1 or not isinstance(space, spaces.Box | spaces.Dict):
                do = "Give a Dict with each picture under a key of its own, beside those of numbers."
                raise UserError("observations mix pictures with other values", ", ".join(name for name, _ in parts), do)
            if reading.fault:
                label, received = key or name, f"{part.dtype} {part.shape}"
                where = f"{label}, {received}" if label else received
                raise UserError(f"observations {reading.fault}", where, CLEARLY)
            return Reader(part, reading.shape, PICTURE, key=name)
        doubt = doubt or reading.doubt
    try:
        sizes = [(name, spaces.flatdim(part)) for name, part in parts]
    except (NotImplementedError, ValueError):
        do = "Wrap it so that it gives those, for example in minigrid's ImgObsWrapper(RGBImgObsWrapper(env))."
        fault = "observations must be images, uint8 (H, W, C) or (H, W), or numbers that Gymnasium can flatten"
        raise UserError(fault, space, do) from None
    names = [(name, size, place) for name, size in sizes for place in range(size)]
    features = [(name if size == 1 else f"{name}[{place}]") if name else f"x{place}" for name, size, place in names]
    shape = (isinstance(space, spaces.Box) and space.shape) or (len(features),)
    return Reader(space, shape, NUMBERS, tuple(features), doubt=doubt)


def resized(env: gymnasium.Env, side: int) -> gymnasium.Env:
    """The environment with pictures of side x side pixels, means over areas; ``UserError`` without pictures."""
    reader = reader_of(env)
    if reader.dtype != PICTURE:
        raise UserError("only pictures can be resized", env.observation_space, "Leave out resize.")

    def small(observation: Any) -> NDArray[np.uint8]:
        return resized_picture(reader.read(observation), side, side)

    space = spaces.Box(0, 255, (side, side, reader.shape[-1]), np.uint8)
    return gymnasium.wrappers.TransformObservation(env, small, space)


def _parts(space: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """By name, the spaces in a ``Dict`` or ``Tuple`` in the order of flattening; any other space itself."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in inner:
            yield from _parts(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, space


def check_step(result: Any) -> None:
    """Refuse (``UserError``) a malformed result of ``env.step``; engines call it for the first one."""
    do = "Give (observation, reward, terminated, truncated, info): a finite number, True or False twice, a dict."
    fits = isinstance(result, tuple | list) and len(result) == 5 and isinstance(result[-1], dict)
    if fits:
        _observation, reward, terminated, truncated, _info = result
        single = not any(np.ndim(value) for value in (reward, terminated, truncated))
        truths = single and terminated in (0, 1) and truncated in (0, 1)
        fits = truths and isinstance(reward, SupportsFloat) and math.isfinite(float(reward))
    if not fits:
        raise UserError("the environment's step gave something else than Gymnasium says", f"{result!r:.200}", do)


class Starts:
    """Checks that the same seed always begins the same episode, as training relies on, and the first observation."""

    def __init__(self, reader: Reader):
        self.reader = reader
        self._digests: dict[int, bytes] = {}  # by seed, of the first observation and the generator's state

    def begin(self, env: gymnasium.Env, seed: int) -> Any:
        """The first observation after ``env.reset(seed=seed)``; ``UserError`` if it began another episode before."""
        result: Any = env.reset(seed=seed)
        if not self._digests:
            if not (isinstance(result, tuple | list) and len(result) == 2 and isinstance(result[1], dict)):
                do = "Give (observation, info), info a dict."
                raise UserError(
                    "the environment's reset gave something else than Gymnasium says", f"{result!r:.200}", do
                )
            self.reader.check(result[0])
        start = digest(self.reader.read(result[0]), repr(_generator(env)).encode())
        if self._digests.setdefault(seed, start) != start:
            do = "Pass the seed on: super().reset(seed=seed), in a wrapper self.env.reset(seed=seed, options=options)."
            raise UserError("the environment's reset began two different episodes with the same seed", seed, do)
        return result[0]


def _generator(env: gymnasium.Env) -> Any:
    """The state of the environment's random generator; None if it has none yet."""
    generator = getattr(env.unwrapped, "_np_random", None)
    return getattr(getattr(generator, "bit_generator", None), "state", None)


class Labels:
    """Which of G sub-goals hold in an environment's current state, by the user's functions.

    Either one function per name, or names and one function for all. Names alone, or both kinds of functions, are a
    ``UserError``.
    """

    def __init__(self, sub_goals: Mapping[str, Label] | Sequence[str], together: LabelAll | None = None):
        self.names: tuple[str, ...] = (sub_goals,) if isinstance(sub_goals, str) else tuple(sub_goals)
        self._each = tuple(sub_goals.values()) if isinstance(sub_goals, Mapping) else ()
        self._together = together
        self._checked = False
        if isinstance(sub_goals, Mapping) == (together is not None):
            fault = "sub-goals have functions and labels= too" if together else "nothing says where sub-goals hold"
            do = "Give {name: function}, or names and labels=, a function from the environment to {name: bool}."
            raise UserError(fault, ", ".join(map(str, self.names)), do)

    def of(self, env: gymnasium.Env) -> NDArray[np.bool_]:
        """The labels of an environment's state, bool (G,); ``UserError`` if the first ones are no truth values."""
        labels: Any = self._together(env) if self._together else [label(env) for label in self._each]
        if not self._checked:
            self._check(labels)
        if self._together:
            labels = [labels[name] for name in self.names]
        return np.array([bool(label) for label in labels], dtype=np.bool_)

    def _check(self, labels: Any) -> None:
        do = f"Give True or False for each of {', '.join(self.names)}."
        if self._together and not (isinstance(labels, Mapping) and {*labels} == {*self.names}):
            raise UserError("the function of all labels gave something else", f"{labels!r:.200}", do)
        values = labels.values() if self._together else labels
        for name, value in zip(labels if self._together else self.names, values, strict=True):
            if np.ndim(value) or value not in (0, 1):
                raise UserError(f"the label of {name} is no truth value", f"{value!r:.200}", do)
        self._checked = True


class GymnasiumEngine(TurnEngine):
    """Environments of one layout or several, stepped one after the other.

    Every episode begins with ``reset(seed=layout_seed)``. An observation and its labels identify a state, in whichever
    layout: it keeps its id while it is among the newest ``memory`` distinct ones. Twice as many are kept, so that a
    replay of ``memory`` steps finds its states; older ones are forgotten.

    Episodes are truncated after ``max_steps`` steps, or earlier by the environment. ``success`` is called at the end of
    each, see ``GymnasiumDomain``.
    """

    def __init__(
        self,
        make: MakeEnv,
        labels: Labels,
        layouts: int | Layouts,
        count: int,
        *,
        max_steps: int,
        memory: int = MEMORY,
        success: Success | None = None,
    ):
        self.count, self.max_steps = count, max_steps
        self.layouts: Layouts = layouts if isinstance(layouts, Layouts) else Layouts((layouts,))
        self.memory: int = memory
        self.room = 2 * memory
        self._envs = [make_checked(make) for _ in range(count)]
        self._labeller, self._success = labels, success
        self._checked = False  # the first step
        self._earned, self._succeeded = [0.0] * count, [False] * count  # the episode so far; whether it just succeeded
        self.reader = reader_of(self._envs[0])
        self._starts = Starts(self.reader)
        self.observation_shape, self.observation_dtype = self.reader.shape, self.reader.dtype
        self.n_actions = int(self._envs[0].action_space.n)  # type: ignore[attr-defined]
        self._ring: list[Observations] = []
        self._labels = bytearray()
        self._ids: OrderedDict[bytes, int] = OrderedDict()  # of the states in the ring by digest, oldest first
        self._played: list[list[int]] = [[] for _ in range(count)]
        self.reset()

    @property
    def n_states(self) -> int:
        return len(self._labels) // max(1, len(self._labeller.names))

    def _begin(self, number: int) -> int:
        observation = self._starts.begin(self._envs[number], self.layouts.begin(number))
        self._played[number], self._earned[number] = [], 0.0
        return self._remember(self._envs[number], observation)

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        env = self._envs[number]
        result: Any = env.step(action)
        if not self._checked:
            check_step(result)
            self._checked = True
        observation, reward, terminated, truncated, info = result
        reward, terminated = float(reward), bool(terminated)
        self._played[number].append(action)
        self._earned[number] += reward
        truncated = (bool(truncated) or elapsed >= self.max_steps) and not terminated
        if self._success:
            over = terminated or truncated
            self._succeeded[number] = over and bool(self._success(env, info, self._earned[number], terminated))
        return self._remember(env, observation), reward, terminated, truncated

    def step(self, actions: NDArray[np.int64]) -> Step:
        step = super().step(actions)
        return step._replace(succeeded=np.array(self._succeeded, np.bool_)) if self._success else step

    def _remember(self, env: gymnasium.Env, observation: Any) -> int:
        """The id of an environment's current state."""
        image = self.reader.read(observation)
        labels = self._labeller.of(env).tobytes()
        look, new = digest(image, labels), self.n_states
        state = self._ids.get(look)
        if state is not None and state >= new - self.memory:
            return state
        self._keep(new, image)
        self._labels += labels
        self._file(look, new)
        return new

    def _file(self, look: bytes, identity: int) -> None:
        """Enter a digest's newest id, and drop that of a forgotten state."""
        self._ids[look] = identity
        self._ids.move_to_end(look)
        if self._ids[next(iter(self._ids))] < self.oldest:
            self._ids.popitem(last=False)

    def images(self, ids: NDArray[np.int64], out: Observations | None = None) -> Observations:
        out = self.room_for(len(ids), out)
        for row, identity in enumerate(self._known(ids, kept=True).tolist()):
            out[row] = self._ring[self._place(identity)]
        return out

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.frombuffer(self._labels, np.bool_).reshape(-1, len(self._labeller.names))[ids].copy()

    def labels_now(self) -> NDArray[np.bool_]:
        return np.stack([self._labeller.of(env) for env in self._envs])

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs: the states, and the actions played since each episode began."""
        return {
            **super().snapshot(),
            "images": np.stack(self._ring),
            "labels": np.frombuffer(self._labels, np.uint8).copy(),
            "played": [list(actions) for actions in self._played],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments: replays the current episodes.

        A ``UserError`` if they lead to other states: the environment is not deterministic.
        """
        super().restore(snapshot)
        width = len(self._labeller.names)
        self._labels = bytearray(snapshot["labels"].tobytes())
        self._ring = list(snapshot["images"])
        if len(self._labels) % max(1, width) or len(self._ring) != min(self.n_states, self.room):
            raise ValueError("its pictures and labels differ in number")
        self._ids.clear()
        for identity in range(self.oldest, self.n_states):
            labels = self._labels[identity * width : (identity + 1) * width]
            self._file(digest(self._ring[self._place(identity)], labels), identity)
        for number, actions in enumerate(snapshot["played"]):
            env, seed = self._envs[number], self.layouts.now[number]
            observation, _info = env.reset(seed=seed)
            self._earned[number] = 0.0
            for action in actions:
                observation, reward, *_ = env.step(action)
                self._earned[number] += float(reward)
            kept = self._ring[self._place(int(self.ids[number]))]
            if not np.array_equal(self.reader.read(observation), kept):
                fault = "the environment does not repeat itself for the same seed, so this cannot be resumed"
                raise UserError(fault, f"layout_seed={seed}", ANEW)
        self._played = [list(actions) for actions in snapshot["played"]]
