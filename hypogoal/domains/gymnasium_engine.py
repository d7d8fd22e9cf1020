"""Any Gymnasium environment as an engine: many of it stepped in turn, states by id, each distinct one kept once."""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from numpy.typing import NDArray

from hypogoal.core.checkpoints import ANEW, Unlike, growing
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode, layers
from hypogoal.dataset import NUMBERS, PICTURE, Observations, digest
from hypogoal.domains.base import Layouts, Step, TurnEngine
from hypogoal.domains.observations import Reading, reading_of, resized_picture

MakeEnv = Callable[..., gymnasium.Env]
Label = Callable[[gymnasium.Env], bool]
LabelAll = Callable[[gymnasium.Env], Mapping[str, bool]]
Success = Callable[[gymnasium.Env, dict[str, Any], float, bool], bool]
RESETS = 5  # which a wrapper that drops the seed hardly passes by chance
MEMORY = 110_000  # the replay's 1e5 transitions and what is not yet in it


def made(make: Callable[..., gymnasium.Env], **arguments: Any) -> gymnasium.Env:
    """What a function of the user's own makes; a ``UserError`` where it fails, or makes no environment."""
    with UsersCode("the environment", make, failed="cannot be made:") as code:
        env: Any = make(**arguments)
        if not isinstance(env, gymnasium.Env):
            code.refuse(
                f"is a {type(env).__name__}, not a gymnasium.Env", "Give a function that returns a gymnasium.Env."
            )
        return env


def make_checked(make: MakeEnv) -> gymnasium.Env:
    """An environment whose observations can be read, and actions are ``Discrete``; else a ``UserError``."""
    env = made(make)
    look_of(env)
    with UsersCode("the environment", env, failed="has no spaces:"):
        actions = env.action_space
    if not isinstance(actions, spaces.Discrete) or actions.start != 0:
        raise UserError("actions must be Discrete(n), from 0", actions, "Wrap it so that they are.")
    return env


class Look(NamedTuple):
    """How observations of a space are read: as arrays of one shape and type, see ``dataset.Observations``.

    ``features`` are the names of the numbers in one that is no picture; ``key`` is that of the picture in a dictionary
    with nothing else in it. ``doubt`` is a warning, where numbers may be meant as a picture.
    """

    space: spaces.Space[Any]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    features: tuple[str, ...] = ()
    key: str = ""
    doubt: str = ""

    def read(self, env: gymnasium.Env, observation: Any, method: str = "step") -> Any:
        """An observation (*shape) that ``method`` gave, in memory of its own; ``UserError`` if its space says other."""
        code = UsersCode("the environment", env, method)
        with code:
            if self.key:
                observation = observation[self.key]
            elif not isinstance(self.space, spaces.Box):
                observation = spaces.flatten(self.space, observation)
            values = np.array(observation, order="C")
        given = f"{values.dtype} {values.shape}"
        if self.dtype == NUMBERS and values.dtype.kind in "iufb":
            values = values.astype(NUMBERS)
        if values.dtype != self.dtype or values.shape not in (self.shape, self.space.shape):
            do = f"Make the observation space and the observations agree; the space says {self.dtype} {self.shape}."
            code.refuse(f"gave an observation that does not fit its space: {given}", do)
        if self.dtype == NUMBERS and not np.isfinite(values).all():
            code.refuse("gave an observation with numbers that are not finite", "Give finite ones.")
        return values.reshape(self.shape)


def look_of(env: gymnasium.Env) -> Look:
    """How to read an environment's observations; of spaces that are no numbers, or mix pictures in, a ``UserError``.

    Pictures are a ``Box`` of uint8 (H, W, C) or (H, W), or a ``Dict`` of just that. Any other ``Box`` is float32, see
    ``hypogoal.domains.observations``; what else Gymnasium's ``flatten`` makes numbers of, dictionaries for one, is
    float32 (D,), in that order.
    """
    with UsersCode("the environment", env, failed="has no spaces:"):
        whole = space = env.observation_space
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
            return Look(part, reading.shape, PICTURE, key=name)
        doubt = doubt or reading.doubt
    try:
        sizes = [(name, spaces.flatdim(part)) for name, part in parts]
    except (NotImplementedError, ValueError):
        do = "Wrap it so that it gives those, for example in minigrid's ImgObsWrapper(RGBImgObsWrapper(env))."
        what = "observations must be images, uint8 (H, W, C) or (H, W), or numbers that Gymnasium can flatten"
        raise UserError(what, whole, do) from None
    names = [(name, size, place) for name, size in sizes for place in range(size)]
    features = [(name if size == 1 else f"{name}[{place}]") if name else f"x{place}" for name, size, place in names]
    shape = (isinstance(space, spaces.Box) and space.shape) or (len(features),)
    return Look(space, shape, NUMBERS, tuple(features), doubt=doubt)


def _wrapped(reading: Reading, key: str) -> str:
    """The wrappers that make observations, or the part of a dictionary with this key, what they may be meant to be."""
    numbers = "of numbers: env = gymnasium.wrappers.FlattenObservation(env)"
    if reading.picture is None:
        return f"Give pictures, uint8 (H, W, C); {numbers}"
    function = reading.picture.expression()
    if key:
        function = function.replace("x", f"x[{key!r}]", 1)
    box = f'gymnasium.spaces.Box(0, 255, {reading.picture.shape}, "uint8")'
    return f"Of pictures: env = gymnasium.wrappers.TransformObservation(env, lambda x: {function}, {box}); {numbers}"


def resized(env: gymnasium.Env, side: int) -> gymnasium.Env:
    """The same with pictures of side x side pixels, means over areas; without pictures a ``UserError``."""
    look = look_of(env)
    if look.dtype != PICTURE:
        raise UserError("only pictures can be resized", env.observation_space, "Leave out resize.")

    def small(observation: Any) -> NDArray[np.uint8]:
        return resized_picture(look.read(env, observation), side, side)

    space = spaces.Box(0, 255, (side, side, look.shape[-1]), np.uint8)
    return gymnasium.wrappers.TransformObservation(env, small, space)


def _parts(space: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The spaces in a ``Dict`` or ``Tuple``, in the order in which they are flattened, by name; else itself."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in inner:
            yield from _parts(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, space


def begun(env: gymnasium.Env, **arguments: Any) -> tuple[Any, dict[str, Any]]:
    """What ``env.reset(**arguments)`` gives: an observation, see :class:`Look`, and a dict; else a ``UserError``."""
    with UsersCode("the environment's reset", env, "reset") as code:
        try:
            given: Any = env.reset(**arguments)
        except Exception:
            code.target = _bad_reset(env, arguments)
            raise
        if not _complete(given, 2):
            code.target = _bad_reset(env, arguments)
            code.refuse(f"gave {_kinds(given)}", "Give (observation, info), info a dict.")
        return given[0], given[1]


def stepped(env: gymnasium.Env, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """What ``env.step(action)`` gives: an observation, see :class:`Look`, and the rest; else a ``UserError``."""
    with UsersCode("the environment's step", env, "step") as code:
        try:
            given: Any = env.step(action)
        except Exception:
            code.target = _bad_step(env, action)
            raise
        if not _complete(given, 5):
            code.target = _bad_step(env, action)
            do = "Give (observation, reward, terminated, truncated, info), info a dict."
            code.refuse(f"gave {_kinds(given)}", do)
        number, over = code.number(given[1], "the reward"), code.truth(given[2], "terminated")
        return given[0], number, over, code.truth(given[3], "truncated"), given[4]


class Starts:
    """How the episodes of each layout begin: training relies on the same seed to begin the same episode."""

    def __init__(self, look: Look):
        self.look = look
        self._known: dict[int, bytes] = {}  # by seed, a digest of the first observation and the generator

    def begin(self, env: gymnasium.Env, seed: int) -> Any:
        """What ``env.reset(seed=seed)`` shows; a ``UserError`` where it showed, or will draw, something else before."""
        observation, _info = begun(env, seed=seed)
        start = digest(self.look.read(env, observation, "reset"), repr(_generator(env)).encode())
        if self._known.setdefault(seed, start) != start:
            do = "Pass the seed on: super().reset(seed=seed), in a wrapper self.env.reset(seed=seed, options=options)."
            layer = culprit(env, lambda layer: not _repeats(layer, seed))
            code = UsersCode("the environment's reset", layer, "reset")
            code.refuse(f"began two different episodes with seed={seed}", do)
        return observation


def culprit(env: gymnasium.Env, broken: Callable[[gymnasium.Env], bool]) -> Any:
    """Of an environment and its wrappers the class of the innermost that is ``broken``; all where it does not show.

    Those around a broken one are broken, too.
    """
    return next((type(layer) for layer in reversed(layers(env)) if broken(layer)), env)


def _bad_reset(env: gymnasium.Env, arguments: Mapping[str, Any]) -> Any:
    return culprit(env, lambda layer: _broken(lambda: layer.reset(**arguments), 2))


def _bad_step(env: gymnasium.Env, action: int) -> Any:
    return culprit(env, lambda layer: _broken(lambda: (layer.reset(), layer.step(action))[1], 5))


def _complete(given: Any, size: int) -> bool:
    """Whether this is what ``reset`` (2 parts) or ``step`` (5) should give, as far as its form goes."""
    return isinstance(given, tuple | list) and len(given) == size and isinstance(given[-1], dict)


def _broken(call: Callable[[], Any], size: int) -> bool:
    """Whether a call of ``reset`` or ``step`` fails, or does not give so many parts."""
    try:
        return not _complete(call(), size)
    except Exception:  # noqa: BLE001 - whatever own code raises
        return True


def _repeats(env: gymnasium.Env, seed: int) -> bool:
    """Whether episodes begin alike for the same seed, as far as ``RESETS`` show it."""
    try:
        starts = [(deepcopy(env.reset(seed=seed)[0]), _generator(env)) for _ in range(RESETS)]
    except Exception:  # noqa: BLE001 - whatever own code raises
        return False
    return all(data_equivalence(start, starts[0], exact=True) for start in starts)


def _generator(env: gymnasium.Env) -> Any:
    """The state of the environment's random numbers; None where it has none so far."""
    generator = getattr(env.unwrapped, "_np_random", None)
    return getattr(getattr(generator, "bit_generator", None), "state", None)


def _kinds(given: object) -> str:
    """The types of what was given."""
    if isinstance(given, tuple | list):
        return f"({', '.join(type(part).__name__ for part in given)})"
    return f"no tuple but a {type(given).__name__}"


class Labels:
    """Which of G sub-goals hold in an environment's current state, as a user's own functions say.

    That is a function for each name, or names and one function that says all. Names alone, or both, are a
    ``UserError``.
    """

    def __init__(self, sub_goals: Mapping[str, Label] | Sequence[str], together: LabelAll | None = None):
        self.names: tuple[str, ...] = (sub_goals,) if isinstance(sub_goals, str) else tuple(sub_goals)
        self._each = tuple(sub_goals.values()) if isinstance(sub_goals, Mapping) else ()
        self._together = together
        if isinstance(sub_goals, Mapping) == (together is not None):
            what = "sub-goals have functions and labels= too" if together else "nothing says where sub-goals hold"
            do = "Give {name: function}, or names and labels=, a function from the environment to {name: bool}."
            raise UserError(what, ", ".join(map(str, self.names)), do)

    def of(self, env: gymnasium.Env) -> NDArray[np.bool_]:
        """Asked of an environment, bool (G,); a ``UserError`` where a function fails, or says something else."""
        if self._together:
            return self._all(env, self._together)
        told = []
        with UsersCode("a sub-goal's function") as code:
            for label in self._each:
                code.target = label
                told.append(code.truth(label(env), "the label"))
        return np.array(told, dtype=np.bool_)

    def _all(self, env: gymnasium.Env, together: LabelAll) -> NDArray[np.bool_]:
        with UsersCode("the function of all labels", together) as code:
            told: Any = together(env)
            do = f"Give a dictionary of {', '.join(self.names)}, each True or False."
            if not isinstance(told, Mapping):
                code.refuse(f"gave a {type(told).__name__}, not a dictionary", do)
            for name in self.names:
                if name not in told:
                    code.refuse(f"gave no label for {name}", do)
            for name in told:
                if name not in self.names:
                    code.refuse(f"gave a label for {name!r}, which is not a sub-goal", do)
            return np.array([code.truth(told[name], f"the label of {name}") for name in self.names], np.bool_)


class GymnasiumEngine(TurnEngine):
    """Environments of one layout or several, stepped one after the other.

    Every episode begins with ``reset(seed=layout_seed)``. States are told apart by what is seen and by their labels, in
    whichever layout: the same picture with the same labels has the same id again while it is among the newest
    ``memory`` distinct ones.
    Twice as many are kept, so that what a replay of ``memory`` steps holds is still there; older ones are forgotten.

    Episodes are truncated after ``max_steps`` steps, where the
    environment does not do so earlier. ``success`` is asked at the end of each, see ``GymnasiumDomain``.
    """

    alike = True

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
        self._ask, self._success = labels, success
        self._earned, self._succeeded = [0.0] * count, [False] * count  # in the episode so far; it ended so just now
        self.look = look_of(self._envs[0])
        self._starts = Starts(self.look)
        self.observation_shape, self.observation_dtype = self.look.shape, self.look.dtype
        self.n_actions = int(self._envs[0].action_space.n)  # type: ignore[attr-defined]
        self._ring: list[Observations] = []
        self._labels = bytearray()
        self._ids: OrderedDict[bytes, int] = OrderedDict()  # of the states in the ring, by digest, the oldest first
        self._played: list[list[int]] = [[] for _ in range(count)]
        self.reset()

    @property
    def n_states(self) -> int:
        return len(self._labels) // max(1, len(self._ask.names))

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
        """The id of what an environment is in now."""
        image = self.look.read(env, observation)
        labels = self._ask.of(env).tobytes()
        look, new = digest(image, labels), self.n_states
        known = self._ids.get(look)
        if known is not None and known >= new - self.memory:
            return known
        if len(self._ring) < 2 * self.memory:
            self._ring.append(image)
        else:
            self._ring[new % (2 * self.memory)] = image
        self._labels += labels
        self._file(look, new)
        return new

    def _file(self, look: bytes, identity: int) -> None:
        """The newest id of this digest; those of forgotten states go."""
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
        every = np.frombuffer(self._labels, np.bool_).reshape(-1, len(self._ask.names))
        return every[ids].copy()

    def labels_now(self) -> NDArray[np.bool_]:
        return np.stack([self._ask.of(env) for env in self._envs])

    def snapshot(self) -> dict[str, Any]:
        """What a resumed run needs to go on exactly: the states, and what was played since each episode began."""
        return {
            "ids": self.ids.copy(),
            "elapsed": self.elapsed.copy(),
            "images": growing(np.stack(self._ring)),
            "labels": growing(np.frombuffer(self._labels, np.uint8).copy()),
            "played": [growing(actions, 0) for actions in self._played],
            **({"layouts": self.layouts.snapshot()} if self.layouts.many else {}),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made alike: episodes are played up to there.

        Where they lead to other states, the environment is not the same for the same seed, it is a ``UserError``.
        """
        width, size = len(self._ask.names), 2 * self.memory
        self._labels = bytearray(snapshot["labels"].tobytes())
        self._ring = list(snapshot["images"])
        if len(self._labels) % max(1, width) or len(self._ring) != min(self.n_states, size):
            raise Unlike("at /loop/engine: its pictures and labels are not as many")
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
            here, was = self.look.read(env, observation), int(snapshot["ids"][number])
            if not np.array_equal(here, self._ring[was % size]):
                what = "the environment does not repeat itself for the same seed, so this cannot be resumed"
                raise UserError(what, f"layout_seed={seed}", ANEW)
        self._played = [list(actions) for actions in snapshot["played"]]
        self.ids, self.elapsed = snapshot["ids"].copy(), snapshot["elapsed"].copy()
