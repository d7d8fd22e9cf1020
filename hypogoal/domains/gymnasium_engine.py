"""Any Gymnasium environment as an engine: many copies stepped in turn, states by id, each distinct one kept once."""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from numpy.typing import NDArray

from hypogoal.core.checkpoints import ANEW
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode, layers
from hypogoal.dataset import NUMBERS, PICTURE, Observations, digest
from hypogoal.domains.base import Layouts, Step, TurnEngine
from hypogoal.domains.observations import Reading, reading_of, resized_picture

MakeEnv = Callable[..., gymnasium.Env]
Label = Callable[[gymnasium.Env], bool]
LabelAll = Callable[[gymnasium.Env], Mapping[str, bool]]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
RESETS = 5  # a wrapper that drops the seed is unlikely to begin alike that often
MEMORY = 110_000  # the replay's 1e5 transitions and those not yet in it


def made(make: Callable[..., gymnasium.Env], **arguments: Any) -> gymnasium.Env:
    """The environment that a user's function makes; a ``UserError`` if it fails or returns something else."""
    with UsersCode("the environment", make, failed="cannot be made:") as code:
        env: Any = make(**arguments)
        if not isinstance(env, gymnasium.Env):
            code.refuse(
                f"is a {type(env).__name__}, not a gymnasium.Env", "Give a function that returns a gymnasium.Env."
            )
        return env


def make_checked(make: MakeEnv) -> gymnasium.Env:
    """An environment with readable observations and ``Discrete`` actions; else a ``UserError``."""
    env = made(make)
    reader_of(env)
    with UsersCode("the environment", env, failed="has no spaces:"):
        actions = env.action_space
    if not isinstance(actions, spaces.Discrete) or actions.start != 0:
        raise UserError("actions must be Discrete(n), from 0", actions, "Wrap it so that they are.")
    return env


class Reader(NamedTuple):
    """Reads observations of a space as arrays of one shape and type, see ``dataset.Observations``.

    ``features`` names the numbers of a non-image observation; ``key`` is that of the only entry of a dictionary, a
    picture. ``doubt`` is a warning that numbers may be meant as a picture.
    """

    space: spaces.Space[Any]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    features: tuple[str, ...] = ()
    key: str = ""
    doubt: str = ""

    def read(self, env: gymnasium.Env, observation: Any, method: str = "step") -> Any:
        """A copy (*shape) of an observation that ``method`` returned; ``UserError`` if it does not fit its space."""
        code = UsersCode("the environment", env, method)
        with code:
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
            code.refuse(f"gave an observation that does not fit its space: {received}", do)
        if self.dtype == NUMBERS and not np.isfinite(values).all():
            code.refuse("gave an observation with numbers that are not finite", "Give finite ones.")
        return values.reshape(self.shape)


def reader_of(env: gymnasium.Env) -> Reader:
    """A reader of an environment's observations; a ``UserError`` if they are no numbers, or mix pictures with others.

    Pictures are a ``Box`` of uint8 (H, W, C) or (H, W), or a ``Dict`` of just that. Any other ``Box`` is float32, see
    ``hypogoal.domains.observations``. Other spaces that Gymnasium's ``flatten`` accepts, such as dictionaries, become
    float32 (D,) in its order.
    """
    with UsersCode("the environment", env, failed="has no spaces:"):
        space = env.observation_space
    parts, doubt = list(_parts(space)), ""
    for name, part in parts:
        if not isinstance(part, spaces.Box):
            continue
        reading = reading_of(part.shape, part.dtype, float(np.max(part.high, initial=0)))
        if reading.dtype == PICTURE or reading.fault:
            if len(parts) > 1 or not isinstance(space, spaces.Box | spaces.Dict):
                do = "Wrap it in gymnasium.wrappers.FilterObservation, and keep the picture alone, or all but pictures."
                raise UserError("observations mix pictures with other values", ", ".join(name for name, _ in parts), do)
            if reading.fault:
                raise UserError(f"observations {reading.fault}", f"{part.dtype} {part.shape}", _wrapped(reading, name))
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


def _wrapped(reading: Reading, key: str) -> str:
    """The wrappers that turn observations, or a dictionary's entry ``key``, into what they may be meant to be."""
    numbers = "of numbers: env = gymnasium.wrappers.FlattenObservation(env)"
    if reading.picture is None:
        return f"Give pictures, uint8 (H, W, C); {numbers}"
    function = reading.picture.expression()
    if key:
        function = function.replace("x", f"x[{key!r}]", 1)
    box = f'gymnasium.spaces.Box(0, 255, {reading.picture.shape}, "uint8")'
    return f"Of pictures: env = gymnasium.wrappers.TransformObservation(env, lambda x: {function}, {box}); {numbers}"


def resized(env: gymnasium.Env, side: int) -> gymnasium.Env:
    """The environment with pictures of side x side pixels, means over areas; ``UserError`` without pictures."""
    reader = reader_of(env)
    if reader.dtype != PICTURE:
        raise UserError("only pictures can be resized", env.observation_space, "Leave out resize.")

    def small(observation: Any) -> NDArray[np.uint8]:
        return resized_picture(reader.read(env, observation), side, side)

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


def begun(env: gymnasium.Env, **arguments: Any) -> tuple[Any, dict[str, Any]]:
    """``env.reset(**arguments)``: an observation, see :class:`Reader`, and a dict; ``UserError`` if malformed."""
    with UsersCode("the environment's reset", env, "reset") as code:
        try:
            result: Any = env.reset(**arguments)
        except Exception:
            code.target = _bad_reset(env, arguments)
            raise
        if not _well_formed(result, 2):
            code.target = _bad_reset(env, arguments)
            code.refuse(f"gave {_types(result)}", "Give (observation, info), info a dict.")
        return result[0], result[1]


def stepped(env: gymnasium.Env, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """``env.step(action)``: an observation, see :class:`Reader`, and the rest; ``UserError`` if malformed."""
    with UsersCode("the environment's step", env, "step") as code:
        try:
            result: Any = env.step(action)
        except Exception:
            code.target = _bad_step(env, action)
            raise
        if not _well_formed(result, 5):
            code.target = _bad_step(env, action)
            do = "Give (observation, reward, terminated, truncated, info), info a dict."
            code.refuse(f"gave {_types(result)}", do)
        reward, terminated = code.number(result[1], "the reward"), code.truth(result[2], "terminated")
        return result[0], reward, terminated, code.truth(result[3], "truncated"), result[4]


class Starts:
    """Checks that the same seed always begins the same episode, as training relies on."""

    def __init__(self, reader: Reader):
        self.reader = reader
        self._digests: dict[int, bytes] = {}  # by seed, of the first observation and the generator's state

    def begin(self, env: gymnasium.Env, seed: int) -> Any:
        """The first observation after ``env.reset(seed=seed)``; ``UserError`` if it began another episode before."""
        observation, _info = begun(env, seed=seed)
        start = digest(self.reader.read(env, observation, "reset"), repr(_generator(env)).encode())
        if self._digests.setdefault(seed, start) != start:
            do = "Pass the seed on: super().reset(seed=seed), in a wrapper self.env.reset(seed=seed, options=options)."
            layer = culprit(env, lambda layer: not _repeats(layer, seed))
            code = UsersCode("the environment's reset", layer, "reset")
            code.refuse(f"began two different episodes with seed={seed}", do)
        return observation


def culprit(env: gymnasium.Env, broken: Callable[[gymnasium.Env], bool]) -> Any:
    """The class of the innermost wrapper that is ``broken``; the whole environment if none shows the fault.

    Wrappers around a broken one are broken, too.
    """
    return next((type(layer) for layer in reversed(layers(env)) if broken(layer)), env)


def _bad_reset(env: gymnasium.Env, arguments: Mapping[str, Any]) -> Any:
    return culprit(env, lambda layer: _malformed(lambda: layer.reset(**arguments), 2))


def _bad_step(env: gymnasium.Env, action: int) -> Any:
    return culprit(env, lambda layer: _malformed(lambda: (layer.reset(), layer.step(action))[1], 5))


def _well_formed(result: Any, size: int) -> bool:
    """Whether ``reset`` (2 parts) or ``step`` (5 parts) returned a tuple that ends in a dictionary."""
    return isinstance(result, tuple | list) and len(result) == size and isinstance(result[-1], dict)


def _malformed(call: Callable[[], Any], size: int) -> bool:
    """Whether a call of ``reset`` or ``step`` fails or returns something malformed."""
    try:
        return not _well_formed(call(), size)
    except Exception:  # noqa: BLE001 - whatever own code raises
        return True


def _repeats(env: gymnasium.Env, seed: int) -> bool:
    """Whether ``RESETS`` episodes of one seed begin alike."""
    try:
        starts = [(deepcopy(env.reset(seed=seed)[0]), _generator(env)) for _ in range(RESETS)]
    except Exception:  # noqa: BLE001 - whatever own code raises
        return False
    return all(data_equivalence(start, starts[0], exact=True) for start in starts)


def _generator(env: gymnasium.Env) -> Any:
    """The state of the environment's random generator; None if it has none yet."""
    generator = getattr(env.unwrapped, "_np_random", None)
    return getattr(getattr(generator, "bit_generator", None), "state", None)


def _types(result: object) -> str:
    """The types of a result's parts, for messages."""
    if isinstance(result, tuple | list):
        return f"({', '.join(type(part).__name__ for part in result)})"
    return f"no tuple but a {type(result).__name__}"


class Labels:
    """Which of G sub-goals hold in an environment's current state, by the user's functions.

    Either one function per name, or names and one function for all. Names alone, or both kinds of functions, are a
    ``UserError``.
    """

    def __init__(self, sub_goals: Mapping[str, Label] | Sequence[str], together: LabelAll | None = None):
        self.names: tuple[str, ...] = (sub_goals,) if isinstance(sub_goals, str) else tuple(sub_goals)
        self._each = tuple(sub_goals.values()) if isinstance(sub_goals, Mapping) else ()
        self._together = together
        if isinstance(sub_goals, Mapping) == (together is not None):
            fault = "sub-goals have functions and labels= too" if together else "nothing says where sub-goals hold"
            do = "Give {name: function}, or names and labels=, a function from the environment to {name: bool}."
            raise UserError(fault, ", ".join(map(str, self.names)), do)

    def of(self, env: gymnasium.Env) -> NDArray[np.bool_]:
        """The labels of an environment's state, bool (G,); ``UserError`` if a function returns no truth value."""
        if self._together:
            return self._all(env, self._together)
        labels = []
        with UsersCode("a sub-goal's function") as code:
            for label in self._each:
                code.target = label
                labels.append(code.truth(label(env), "the label"))
        return np.array(labels, dtype=np.bool_)

    def _all(self, env: gymnasium.Env, together: LabelAll) -> NDArray[np.bool_]:
        with UsersCode("the function of all labels", together) as code:
            labels: Any = together(env)
            do = f"Give a dictionary of {', '.join(self.names)}, each True or False."
            if not isinstance(labels, Mapping):
                code.refuse(f"gave a {type(labels).__name__}, not a dictionary", do)
            for name in self.names:
                if name not in labels:
                    code.refuse(f"gave no label for {name}", do)
            for name in labels:
                if name not in self.names:
                    code.refuse(f"gave a label for {name!r}, which is not a sub-goal", do)
            return np.array([code.truth(labels[name], f"the label of {name}") for name in self.names], np.bool_)


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
        self._envs = [make_checked(make) for _ in range(count)]
        self._labeller, self._success = labels, success
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

    @property
    def oldest(self) -> int:
        return self.n_states - len(self._ring)

    def _begin(self, number: int) -> int:
        observation = self._starts.begin(self._envs[number], self.layouts.begin(number))
        self._played[number], self._earned[number] = [], 0.0
        return self._remember(self._envs[number], observation)

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        env = self._envs[number]
        observation, reward, terminated, truncated, info = stepped(env, action)
        self._played[number].append(action)
        self._earned[number] += reward
        truncated = (truncated or elapsed >= self.max_steps) and not terminated
        if self._success:
            with UsersCode("the domain's success", self._success) as code:
                self._succeeded[number] = (terminated or truncated) and code.truth(
                    self._success(env, info, self._earned[number], terminated), "success"
                )
        return self._remember(env, observation), reward, terminated, truncated

    def step(self, actions: NDArray[np.int64]) -> Step:
        step = super().step(actions)
        return step._replace(succeeded=np.array(self._succeeded, np.bool_)) if self._success else step

    def _remember(self, env: gymnasium.Env, observation: Any) -> int:
        """The id of an environment's current state."""
        image = self.reader.read(env, observation)
        labels = self._labeller.of(env).tobytes()
        look, new = digest(image, labels), self.n_states
        state = self._ids.get(look)
        if state is not None and state >= new - self.memory:
            return state
        if len(self._ring) < 2 * self.memory:
            self._ring.append(image)
        else:
            self._ring[new % (2 * self.memory)] = image
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
        if len(ids) and not self.oldest <= ids.min() <= ids.max() < self.n_states:
            raise ValueError(f"states {self.oldest} to {self.n_states - 1} are kept, not {ids.min()} to {ids.max()}")
        out = self.room_for(len(ids), out)
        for row, identity in enumerate(ids.tolist()):
            out[row] = self._ring[identity % (2 * self.memory)]
        return out

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.frombuffer(self._labels, np.bool_).reshape(-1, len(self._labeller.names))[ids].copy()

    def labels_now(self) -> NDArray[np.bool_]:
        return np.stack([self._labeller.of(env) for env in self._envs])

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs: the states, and the actions played since each episode began."""
        return {
            "ids": self.ids.copy(),
            "elapsed": self.elapsed.copy(),
            "images": np.stack(self._ring),
            "labels": np.frombuffer(self._labels, np.uint8).copy(),
            "played": [list(actions) for actions in self._played],
            **({"layouts": self.layouts.snapshot()} if self.layouts.many else {}),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments: replays the current episodes.

        A ``UserError`` if they lead to other states: the environment is not deterministic.
        """
        width, size = len(self._labeller.names), 2 * self.memory
        self._labels = bytearray(snapshot["labels"].tobytes())
        self._ring = list(snapshot["images"])
        if len(self._labels) % max(1, width) or len(self._ring) != min(self.n_states, size):
            raise ValueError("its pictures and labels differ in number")
        self._ids.clear()
        for identity in range(self.oldest, self.n_states):
            labels = self._labels[identity * width : (identity + 1) * width]
            self._file(digest(self._ring[identity % size], labels), identity)
        if self.layouts.many:
            self.layouts.restore(snapshot["layouts"])
        for number, actions in enumerate(snapshot["played"]):
            env, seed = self._envs[number], self.layouts.now[number]
            observation, _info = begun(env, seed=seed)
            self._earned[number] = 0.0
            for action in actions:
                observation, reward, *_ = stepped(env, action)
                self._earned[number] += reward
            state = int(snapshot["ids"][number])
            if not np.array_equal(self.reader.read(env, observation), self._ring[state % size]):
                fault = "the environment does not repeat itself for the same seed, so this cannot be resumed"
                raise UserError(fault, f"layout_seed={seed}", ANEW)
        self._played = [list(actions) for actions in snapshot["played"]]
        self.ids, self.elapsed = snapshot["ids"].copy(), snapshot["elapsed"].copy()
