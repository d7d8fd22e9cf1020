"""What observations are taken for, and numbers in domains made from Gymnasium environments (Spec B6)."""

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import corridor_env
import gymnasium
import h5py
import numpy as np
import pytest
from command_line import run, settings, trusting
from corridor_env import SENSED
from gymnasium import spaces

from hypogoal.baselines.engine_env import EngineEnv
from hypogoal.check import check_domain
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.data import open_dataset, write_dataset
from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.domains.gymnasium.reader import reader_of
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.importing.states import take
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import Setup, make_engine, of_ensemble
from hypogoal.observations import DEVIATIONS, NUMBERS, PICTURE, standard_of, standardised

NAMES = (*(f"layout[{number}]" for number in range(8)), "noise", "place[0]", "place[1]")
SMALL = GymnasiumConfig(heldout_seeds=(4, 5), steps=80)


class Says(gymnasium.Env[Any, int]):
    """Gives what it is told to, in this space."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: spaces.Space[Any], observation: Any):
        self.observation_space, self.observation = space, observation

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation, {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation, 0.0, False, False, {}


def read(space: spaces.Space[Any], observation: Any) -> Any:
    env = Says(space, observation)
    look = reader_of(env.observation_space)
    values = look.read(observation)
    assert values.dtype == look.dtype and values.shape == look.shape
    return values.tolist(), look.features


UNIT = spaces.Box(-1, 1, (2,), np.float64)


@pytest.mark.parametrize(
    ("space", "observation", "values", "features"),
    [
        (UNIT, np.array([0.5, -1.0]), [0.5, -1.0], ("x0", "x1")),
        (spaces.Box(0, 255, (2,), np.uint8), np.array([3, 4], np.uint8), [3.0, 4.0], ("x0", "x1")),
        (spaces.Box(0, 9, ()), np.float32(2), [2.0], ("x0",)),
        (spaces.Box(0, 1, (1, 1, 2)), np.ones((1, 1, 2)), [[[1.0, 1.0]]], ("x0", "x1")),
        (spaces.Discrete(3), 2, [0.0, 0.0, 1.0], ("x0", "x1", "x2")),
        (spaces.Discrete(2), np.array(1), [0.0, 1.0], ("x0", "x1")),
        (spaces.Tuple((UNIT, spaces.Discrete(2))), (np.ones(2), 0), [1.0, 1.0, 1.0, 0.0],
         ("0[0]", "0[1]", "1[0]", "1[1]")),
        (spaces.Dict({"b": UNIT, "a": spaces.Dict(c=UNIT)}), {"a": {"c": np.zeros(2)}, "b": np.ones(2)},
         [0.0, 0.0, 1.0, 1.0], ("a.c[0]", "a.c[1]", "b[0]", "b[1]")),
    ],
)  # fmt: skip
def test_numbers_are_read_in_a_fixed_order(space: Any, observation: Any, values: Any, features: Any) -> None:
    """Spec B6: as Gymnasium flattens them, each with a name; a box keeps its shape."""
    assert read(space, observation) == (values, features)


@pytest.mark.parametrize("observation", [np.ones(3), "no"])
def test_what_is_no_such_number_is_one_line(observation: Any) -> None:
    """Spec G2."""
    with pytest.raises(UserError, match="an observation that does not fit"):
        read(UNIT, observation)


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf, 1e300])
def test_a_number_that_is_not_finite_is_named(lost: float) -> None:
    """Spec G2, G3: where it is read, in a row and beside a picture."""
    wide = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    with pytest.raises(UserError, match="not finite in float32: x1, such as"):
        read(wide, np.array([0.5, lost]))
    both = spaces.Dict(front=spaces.Box(0, 255, (20, 20, 3), np.uint8), state=wide)
    with pytest.raises(UserError, match=r"not finite in float32: state\[1\], such as"):
        read(both, {"front": np.zeros((20, 20, 3), np.uint8), "state": np.array([0.5, lost])})


NORTHINGS = [
    (spaces.Box(0, 1e7, (2,), np.float64), lambda place: np.array([4_250_000 + 0.2 * place, 1.0])),
    (spaces.Box(0, 2**62, (2,), np.int64), lambda place: np.array([17 * 10**17 + place, 1])),
    (spaces.Dict(at=spaces.Box(0, 180, (1,), np.float64)), lambda place: {"at": np.array([48.1 + 2e-6 * place])}),
]


@pytest.mark.parametrize(("space", "observation"), NORTHINGS)
def test_numbers_that_float32_makes_equal_are_refused(space: Any, observation: Any) -> None:
    """Spec G2: map coordinates, a clock in nanoseconds, degrees; as an import refuses them."""
    look = reader_of(space)
    for step in range(15):
        look.read(observation(step % 8))
    with pytest.raises(UserError, match=r"float32 makes equal: (x0|at), such as .* Subtract an offset"):
        look.read(observation(7))


def test_numbers_that_float32_tells_apart_are_read() -> None:
    """Also where something at rest trembles by less than anybody notices."""
    look = reader_of(spaces.Box(-np.inf, np.inf, (3,), np.float64))
    rng = np.random.default_rng(0)
    for _ in range(70):
        look.read(np.array([rng.normal(), 0.42 + 1e-10 * rng.normal(), 1e-30 * rng.normal()]))


class Sensor(corridor_env.CorridorEnv):
    """Its reading at the last cell but one is lost."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)  # type: ignore[assignment]

    def image(self) -> Any:
        return np.array([np.nan if self.cell == 4 else self.cell / 5, self.layout])


def test_what_cannot_be_read_is_refused_by_check_and_collect() -> None:
    """Spec G2: with its place; nothing is said of seeds."""
    domain, fault = GymnasiumDomain(Sensor, corridor_env.SUB_GOALS), "not finite in float32: x0"
    with pytest.raises(UserError, match=rf"{fault}.* at layout_seed, episode, step \(0, \d+, \d+\)"):
        domain.collect(SMALL, 0, Progress("collect", 1, quiet=True))
    *_, last = check_domain(domain, SMALL)
    assert not last.ok and fault in last.text


def test_a_picture_alone_in_a_dictionary_is_that_picture() -> None:
    """Spec B6."""
    framed, plain = (domain.make_engine(0, 2, 30) for domain in (corridor_env.FRAMED, corridor_env.DOMAIN))
    assert framed.observation_shape == (48, 48, 3) and framed.observation_dtype == np.uint8
    np.testing.assert_array_equal(framed.images(framed.ids), plain.images(plain.ids))


def test_collected_numbers_are_kept_with_their_names(tmp_path: Any) -> None:
    """Spec A1, A8: float32, and which is which; a file whose numbers are not finite is refused."""
    found = SENSED.collect(SMALL, 0, Progress("collect", 1, quiet=True))
    assert found.observation_shape == (11,) and len(found.labelled.observations) == corridor_env.LENGTH
    path = tmp_path / "sensed.h5"
    write_dataset(path, found, domain="own", config={}, seed=0)
    data = open_dataset(path)
    assert data.observation_dtype == NUMBERS and data.observation_bytes == 44 and tuple(data.features()) == NAMES
    np.testing.assert_array_equal(data.unlabelled(), found.unlabelled.observations)
    place = data.labelled("left-end").observations[:, 9]
    np.testing.assert_array_equal(data.labelled("left-end").labels, place == 0)
    with h5py.File(path, "r+") as file:
        file["unlabelled/observations"][0, 0] = np.nan
    with pytest.raises(UserError, match="not finite"):
        open_dataset(path).unlabelled()
    found.unlabelled.observations[2, 0] = np.inf
    with pytest.raises(UserError, match="not finite: /unlabelled, state 2"):
        write_dataset(path, found, domain="own", config={}, seed=0)


def test_numbers_are_standardised_and_cut() -> None:
    """Spec C2: by mean and deviation of the training data; what never changes is left as far away as it is."""
    rng = np.random.default_rng(0)
    data = np.stack([rng.normal(5, 2, 4000), np.full(4000, 7.0)], 1).astype(np.float32)
    mean, deviation = standard_of((2,), data[:1000], data[1000:])
    np.testing.assert_allclose(mean, [data[:, 0].mean(), 7], rtol=1e-5)
    np.testing.assert_allclose(deviation, [data[:, 0].std(), 1], rtol=1e-5)
    seen = standardised(np.array([[5.0, 7.5], [500.0, 7.0]], np.float32), mean, deviation)
    assert seen.dtype == NUMBERS and seen[1].tolist() == [DEVIATIONS, 0.0]
    np.testing.assert_allclose(seen[0], [(5 - mean[0]) / deviation[0], 0.5], rtol=1e-5)
    assert [part.tolist() for part in standard_of((2,))] == [[0, 0], [1, 1]]


def test_agents_see_numbers_by_the_standard_that_members_have(tmp_path: Path) -> None:
    """Spec C2, D1: that of the training data, which an engine does not know by itself."""
    data, made = tmp_path / "data.h5", tmp_path / "ensemble"
    run("collect", "corridor_env:SENSED", "--out", data, "-q", *settings("steps=80", "heldout_seeds=4"))
    with trusting():
        run("train-ensemble", data, "--out", made, "-q", *settings("steps=2", "members=1", "workers=1"))
    config = open_artefact(made).config
    setup = Setup(SENSED, config, made, TrainMetaConfig.of(), 0)
    engine = make_engine(setup)
    of_ensemble(setup, engine)
    mean, deviation = read_ensemble(made, config, "left-end").view.standard or (0, 1)
    assert np.any(mean != 0) and engine.standard is not None
    np.testing.assert_array_equal(engine.standard, [mean, deviation])


def test_baselines_see_numbers_standardised_where_a_standard_is_known() -> None:
    """Spec F1: as options do; else as they come."""
    engine = SENSED.make_engine(0, 2, 30)
    numbers = engine.images(engine.ids)
    np.testing.assert_array_equal(EngineEnv(engine).reset(), numbers)
    engine.standard = np.full(11, 2.0, NUMBERS), np.full(11, 4.0, NUMBERS)
    np.testing.assert_allclose(EngineEnv(engine).reset(), (numbers - 2) / 4)


PAGE = Path(__file__).parents[2] / "docs" / "own-domain.md"
TABLE = re.search(r"^\| one observation .*?(?=\n\n)", PAGE.read_text(encoding="utf-8"), re.M | re.S)
assert TABLE
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLE[0].splitlines()[2:]]
CASES = [
    pytest.param(dtype, tuple(map(int, filter(None, shape.split(",")))), outcome, id=f"{dtype}({shape})")
    for _, examples, outcome in ROWS
    for dtype, shape in re.findall(r"`(\w+) \(([\d, ]+)\)`", examples)
]


DTYPES = ("uint8", "int64", "uint16", "bool", "float16", "float32", "float64")


def outcome_of(shape: tuple[int, ...], dtype: str) -> str:
    """What such an observation is taken for: ``picture``, ``numbers``, or ``refused``.

    An ``AssertionError`` where environment and array differ, or it was guessed.
    """
    state = np.ones(shape, dtype)
    env = Says(spaces.Box(0, 1, shape, state.dtype.type), state)
    wide = any(min(pair) > 16 for pair in pairwise(shape))  # the shape of a picture
    of_env, of_array = _refusal(lambda: reader_of(env.observation_space)), _refusal(lambda: take(state, "the state"))
    assert bool(of_env) == bool(of_array), (of_env, of_array)
    if of_env:
        assert dtype == "uint8" or wide, of_env
        return "refused"
    look, (taken, _) = reader_of(env.observation_space), take(state, "the state")
    assert taken.shape == look.shape and (taken.dtype == look.dtype or look.dtype != PICTURE)
    np.testing.assert_array_equal(look.read(env.reset()[0]), taken)
    if look.dtype == PICTURE:
        assert dtype == "uint8" and len(shape) in (2, 3)
        return "picture"
    assert not wide
    return "numbers"


def _refusal(call: Callable[[], object]) -> str:
    """The line with which a call refuses; empty where it does not."""
    try:
        call()
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("dtype", "shape", "outcome"), CASES)
def test_the_table_of_the_page_is_true(dtype: str, shape: tuple[int, ...], outcome: str) -> None:
    """Spec B6: each of its examples, in an environment and in an array."""
    words = {"picture": "a picture"}
    found = outcome_of(shape, dtype)
    assert words.get(found, found) == outcome.removesuffix(", `(H, W, 1)`")
    if outcome.endswith("`(H, W, 1)`"):
        assert take(np.ones(shape, dtype), "the state")[0].shape == (*shape, 1)


def test_the_table_has_all_types_and_every_outcome() -> None:
    assert {case.values[0] for case in CASES} >= set(DTYPES)
    assert {case.values[2] for case in CASES} == {
        "a picture", "a picture, `(H, W, 1)`", "numbers", "refused",
    }  # fmt: skip


def test_frames_and_colours_are_stacked_in_their_order() -> None:
    """Spec B6: wherever they stood, by --stack."""
    whole = np.random.default_rng(0).integers(0, 255, (2, 40, 48, 4, 3), dtype=np.uint8)  # frames, then colours
    wanted = whole.reshape(2, 40, 48, 12)
    for axes in ((2, 0, 1, 3), (2, 3, 0, 1), (0, 1, 3, 2), (3, 0, 1, 2), (3, 2, 0, 1), (0, 1, 2, 3)):
        states = whole.transpose(0, *(axis + 1 for axis in axes))
        with pytest.raises(UserError, match=r"stacks of pictures: .*Give pictures as uint8 .* 'import --stack' puts"):
            take(states[0], "the state")
        np.testing.assert_array_equal([take(state, "the state", stack=True)[0] for state in states], wanted)


def test_minigrids_dictionary_is_read_without_its_text() -> None:
    """Spec B6: a picture and a number by key; a line says so."""
    env = gymnasium.make("minigrid:MiniGrid-Empty-8x8-v0")
    with pytest.warns(UserWarning, match="observations are read without their text: mission"):
        reader = reader_of(env.observation_space)
    seen, _ = env.reset(seed=0)
    read = reader.read(seen)
    assert read.dtype.names == ("direction", "image")
    np.testing.assert_array_equal(read["image"], seen["image"])
    assert read["direction"].tolist() == [1.0, 0.0, 0.0, 0.0]
    nothing_else = spaces.Dict(mission=env.observation_space["mission"])
    with pytest.raises(UserError, match="observations must be images"):
        reader_of(nothing_else)


def test_a_dictionary_hides_no_picture() -> None:
    """Spec B6: stacks, floats and integers in the shape of pictures are no more guessed in there than alone."""
    speed = spaces.Box(0, 1, (2,))
    for shape, dtype in (((4, 48, 48, 3), np.uint8), ((48, 48), np.int64), ((48, 48, 3), np.float32)):
        space = spaces.Dict(a=speed, b=spaces.Box(0, 1, shape, dtype))
        with pytest.raises(UserError, match=r"observations .*: b (u?int|float).* Give pictures as uint8 \(H"):
            reader_of(Says(space, None).observation_space)
        alone = Says(spaces.Dict(b=space["b"]), {"b": np.ones(shape, dtype)})
        with pytest.raises(UserError, match=r"observations .*: b (u?int|float)"):
            reader_of(alone.observation_space)
