"""Recorded play as a source of states (Spec B6, B7): what is played, from which files, and what is refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import corridor_env
import gymnasium
import h5py
import numpy as np
import pytest
from corridor_env import CorridorEnv

from hypogoal.cli import main
from hypogoal.core.config import from_values
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.dataset import Collected, open_dataset
from hypogoal.domains.gymnasium_domain import GymnasiumConfig, GymnasiumDomain
from hypogoal.domains.recorded_play import read_play
from hypogoal.testing import check_domain

TESTS = Path(__file__).parents[1]


class Stairs(gymnasium.Env[np.ndarray, int]):
    """Action 0 climbs, 1 falls to the ground, 2 stays; the task is to be on step 12, which ends the episode.

    The seed is the colour of the ground: what is seen says both.
    """

    observation_space = gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.height, self.colour = 0, seed or 0
        return self._picture(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.height = (self.height + 1, 0, self.height)[action]
        return self._picture(), float(self.height == 12), self.height == 12, False, {}

    def _picture(self) -> np.ndarray:
        picture = np.zeros((32, 32, 3), np.uint8)
        picture[2 * self.height, :, 0] = 255
        picture[..., 1] = self.colour % 256
        return picture


def height(env: gymnasium.Env) -> int:
    return env.unwrapped.height  # type: ignore[attr-defined, no-any-return]


SUB_GOALS = {"half-way": lambda env: height(env) >= 6, "top": lambda env: height(env) == 12}
DOMAIN = GymnasiumDomain(Stairs, SUB_GOALS, defaults={"train-ensemble": {"network": "tiles"}})
SMALL = {"unlabelled_seeds": [1], "heldout_seeds": [2], "steps": 60}
UP = [0] * 12


def written(folder: Path, told: Any) -> str:
    file = folder / "play.json"
    file.write_text(told if isinstance(told, str) else json.dumps(told), encoding="utf-8")
    return str(file)


def way(actions: Sequence[int] = UP, layout_seed: int = 0) -> dict[str, Any]:
    return {"layout_seed": layout_seed, "actions": [*actions]}


def collected(*play: str, domain: GymnasiumDomain = DOMAIN, **settings: Any) -> Collected:
    config = from_values(domain.config_class, {**SMALL, "play": play, **settings}, "collect")
    return domain.collect(config, 0, Progress("collect", 1, quiet=True))


def test_play_is_played_again_and_labelled_by_the_environment(tmp_path: Path) -> None:
    """Spec B7: its states are those of the environment, their labels the domain's functions', in its layout's set."""
    with pytest.raises(UserError, match=r"half-way has no positives .*recorded play \(--play FILE\)"):
        collected()  # at random nobody climbs six steps, see 'steps'
    file = written(tmp_path, [way(), way([0, 2, 0], 1), way([0] * 7, 2)])
    found = collected(file)
    for states, seed, actions in (
        (found.labelled, 0, UP),
        (found.unlabelled, 1, [0, 2, 0]),
        (found.heldout, 2, [0] * 7),
    ):
        env, first = Stairs(), states.where(states.origins["episode"] == 0)
        seen = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)]
        assert set(states.origins["layout_seed"].tolist()) == {seed}
        for image, label, step in zip(first.observations, first.labels, first.origins["step"], strict=True):
            np.testing.assert_array_equal(image, seen[step])
            level = sum(action == 0 for action in actions[:step])
            assert label.tolist() == [level >= 6, level == 12]
        assert len(first.labels) == len({image.tobytes() for image in seen})  # each picture once, none left out
    assert found.labelled.labels.sum(0).tolist() == [7, 1]


def test_play_goes_on_from_recorded_ways(tmp_path: Path) -> None:
    """Spec B7: from somewhere on the way for as many steps as it has, in half of the steps."""
    steps: list[tuple[int, int]] = []  # of each step that is no recorded one, the height it began at, its action

    def fall(env: gymnasium.Env, observation: np.ndarray, rng: np.random.Generator) -> int:
        steps.append((height(env), 1))
        return 1

    file = written(tmp_path, way())
    domain = GymnasiumDomain(Stairs, SUB_GOALS, policy=fall)
    collected(file, domain=domain, explore=0.0, steps=4_000, unlabelled_seeds=[1], max_episode_steps=50)
    began = [height for height, _ in steps if height]
    assert set(began) == set(range(1, 12)), "from each place of the way, and not beyond its end"
    # Of 4,000 steps on layout 0 half are not from the way: those, and all on layouts 1 and 2, are the policy's.
    from_way = len(steps) - 2_000 - 2 * 4_000
    assert 1_000 < from_way < 1_700 and len(began) > 70


def test_policies_share_the_steps(tmp_path: Path) -> None:
    """Spec B7: one policy a sub-goal, as many steps each; None is random play; with recorded play from there too."""
    counts = {"climb": 0, "stay": 0}

    def climb(env: gymnasium.Env, observation: np.ndarray, rng: np.random.Generator) -> int:
        counts["climb"] += 1
        return 0

    def stay(env: gymnasium.Env, observation: np.ndarray, rng: np.random.Generator) -> int:
        counts["stay"] += 1
        return 2

    both = GymnasiumDomain(Stairs, SUB_GOALS, policy={"top": climb, "half-way": stay})
    assert collected(domain=both, explore=0.0).labelled.labels.sum(0).tolist() == [7, 1]
    assert counts == {"climb": 3 * 30, "stay": 3 * 30}
    alone = GymnasiumDomain(Stairs, SUB_GOALS, policy={"top": climb, "half-way": None})
    counts["climb"] = 0
    collected(written(tmp_path, way()), domain=alone, explore=0.0)
    assert 2 * 30 + 15 < counts["climb"] < 2 * 30 + 2 * 15, "from the recorded way it has half, less what is recorded"
    with pytest.raises(UserError, match=r"policies are given by sub-goal: half-way, moon\. These are half-way, top\."):
        GymnasiumDomain(Stairs, SUB_GOALS, policy={"half-way": climb, "moon": stay})


def test_play_is_the_same_for_the_same_seed(tmp_path: Path) -> None:
    """Spec G1."""
    file = written(tmp_path, [way(), way([0] * 9)])
    one, same = (collected(file, steps=500) for _ in range(2))
    for left, right in ((one.labelled, same.labelled), (one.heldout, same.heldout)):
        np.testing.assert_array_equal(left.observations, right.observations)
        for name in left.origins:
            np.testing.assert_array_equal(left.origins[name], right.origins[name])


BAD = [
    ("nonsense", "recorded play is not valid JSON"),
    ([3], "recorded play needs a layout seed and actions"),
    ({"actions": UP}, "recorded play needs a layout seed and actions"),
    (way([]), "recorded play needs a layout seed and actions"),
    (way([0, -1]), "recorded play needs a layout seed and actions"),
    (way([0, True]), "recorded play needs a layout seed and actions"),
    (way([0, 1.5]), "recorded play needs a layout seed and actions"),
    ([way(), way(UP, 7)], r"episode 1\. The seed must be in labelled_seeds, unlabelled_seeds or heldout_seeds"),
    (way([0, 3]), r"actions up to 3: .*play\.json, episode 0\. .* actions in 0 to 2\."),
    ([way(), way([*UP, 2])], r"the episode ends after 12 of 13 actions: .*episode 1\. Leave out the others"),
]


@pytest.mark.parametrize(("told", "message"), BAD)
def test_what_cannot_be_played_is_one_line(told: Any, message: str, tmp_path: Path) -> None:
    """Spec G2."""
    with pytest.raises(UserError, match=message) as caught:
        collected(written(tmp_path, told))
    assert "\n" not in str(caught.value)


def test_an_episode_that_is_cut_is_told(tmp_path: Path) -> None:
    """Spec G2: by the domain's own limit."""
    with pytest.raises(UserError, match=r"ends after 5 of 12 actions.*larger max_episode_steps"):
        collected(written(tmp_path, way()), max_episode_steps=5)


def test_a_minari_dataset_is_recorded_play(tmp_path: Path) -> None:
    """Spec B6: written by minari itself; actions and seeds of its episodes, others are refused."""
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    env = Stairs()

    def dataset(name: str, *seeds: int | None) -> Path:
        folder = tmp_path / name / "data"
        folder.mkdir(parents=True)
        storage = MinariStorage.new(folder, env.observation_space, env.action_space)
        buffers = []
        for number, seed in enumerate(seeds):
            seen = [env.reset(seed=seed or 0)[0], *(env.step(action)[0] for action in UP)]
            ends = [False] * 11 + [True]
            buffers.append(
                EpisodeBuffer(
                    id=number, seed=seed, observations=seen, actions=list(UP), rewards=[0.0] * 12,
                    terminations=ends, truncations=[False] * 12, infos={},
                )
            )  # fmt: skip
        storage.update_episodes(buffers)
        return tmp_path / name

    folder = dataset("played", 0, 2)
    assert [(one.layout_seed, list(one.actions)) for one in read_play(folder)] == [(0, UP), (2, UP)]
    assert collected(str(folder)).heldout.labels.sum(0).tolist() == [7, 1]
    with pytest.raises(UserError, match=r"needs a layout seed and actions: .*episode 0\..*reset\(seed="):
        read_play(dataset("seedless", None))
    with pytest.raises(UserError, match="the dataset is missing"):
        read_play(tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        del file["episode_0/actions"]
    with pytest.raises(UserError, match="episode_0/actions"):
        read_play(folder)


def test_the_command_plays_files_and_the_data_name_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec A8, B6: with the sha256 of each; --resume tells a file that changed since; how long options need is said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(TESTS / "domains"))
    out, few = tmp_path / "data.h5", [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    few = [word.replace("[", "").replace("]", "") for word in few]
    one, two = written(tmp_path, way()), tmp_path / "two.json"
    two.write_text(json.dumps(way([0] * 8, 2)), encoding="utf-8")
    command = ["collect", "test_recorded_play:DOMAIN", "--play", one, "--play", str(two), "--out", str(out), *few]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "top has 1 positive among" in said and "(--play FILE)" in said
    assert "play took up to 6 steps from one sub-goal to the next" in said
    assert "train-options --option-timeout 12 gives options time" in said
    data = open_dataset(out)
    assert data.config["play"] == [one, str(two)]
    digests = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in (one, two)]
    assert [(entry["path"], entry["sha256"]) for entry in data.inputs] == list(
        zip((one, str(two)), digests, strict=True)
    )
    assert main([*command, "--resume"]) == 0
    two.write_text(json.dumps(way([0] * 9, 2)), encoding="utf-8")
    capsys.readouterr()
    assert main([*command, "--resume"]) == 2 and "inputs" in capsys.readouterr().err
    assert main(["collect", "doorkey", "--play", one, "--out", str(tmp_path / "no.h5")]) == 2
    assert "collect has no setting: play" in capsys.readouterr().err
    assert main(["collect", "test_recorded_play:DOMAIN", "--play", "none.json", "--out", str(tmp_path / "no.h5")]) == 2
    assert "missing: none.json" in capsys.readouterr().err
    assert main(["check", "test_recorded_play:DOMAIN", "--play", one, *few]) == 0
    told = capsys.readouterr().out
    assert "top has 1 positive among" in told and "(--play FILE)" in told


def test_check_takes_few_states_and_says_what_all_need() -> None:
    """Spec B6: 2,000 pictures of each layout would be kept; of big ones that is more than a machine may have."""

    class Tall(CorridorEnv):
        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
            self.count = 0
            return super().reset(**kwargs)

        def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
            image, reward, _over, cut, info = super().step(action)
            return image, reward, False, cut, info  # it goes on, and no two pictures are alike

        def image(self) -> np.ndarray:
            self.count += 1
            picture = super().image()
            picture[0, :3, 0] = self.count >> 16, self.count >> 8 & 255, self.count & 255
            return picture

    domain = GymnasiumDomain(Tall, corridor_env.SUB_GOALS)
    config = GymnasiumConfig(states=2_000, steps=2_000, heldout_seeds=(4,), max_episode_steps=2_000)
    kept: list[int] = []
    collect = domain.collect

    def counted(config: GymnasiumConfig, seed: int, progress: Any) -> Collected:
        found = collect(config, seed, progress)
        kept.append(len(found.labelled.labels))
        return found

    domain.collect = counted  # type: ignore[method-assign]
    verdicts = {verdict.name: verdict for verdict in check_domain(domain, config)}
    assert kept == [200, 200]
    assert verdicts["collection"].text.endswith("'collect' keeps up to 55.3 MB, twice that in memory")
