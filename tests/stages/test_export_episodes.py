"""Episodes to and from the real minari package (Spec B6)."""

from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest
from command_line import refuses, run

import hypogoal  # noqa: F401 - registers the environments
from hypogoal.importing.recordings import read_minari

LAYOUT = 100
EPISODES = 3


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where minari looks for datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def test_an_agents_episodes_are_a_minari_dataset(tiny_run: Path, there: Path) -> None:
    """Spec B6: minari reads them, and so do we; played again, their actions lead to the same observations."""
    out = there / "toy-v0"
    run("export", tiny_run / "meta", "--out", out, "--episodes", EPISODES)
    dataset = minari.load_dataset("toy-v0")
    assert dataset.total_episodes == EPISODES
    env = gymnasium.make("hypogoal.envs:hypogoal/DoorKey-8x8-v0", layout_seed=LAYOUT)
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    for episode in dataset.iterate_episodes():
        observation, _ = env.reset()
        np.testing.assert_array_equal(episode.observations[0], observation)
        for step, action in enumerate(episode.actions):
            observation, reward, terminated, _, _ = env.step(action)
            np.testing.assert_array_equal(episode.observations[step + 1], observation)
            assert (episode.rewards[step], episode.terminations[step]) == (reward, terminated)
        assert episode.terminations[-1] != episode.truncations[-1]
        assert not (episode.terminations[:-1] | episode.truncations[:-1]).any()
        assert episode.terminations[-1] or len(episode.actions) == 64
        options = episode.infos["option"]
        assert options[0] == -1 and {*options[1:].tolist()} <= {*range(4)}
    for ours, theirs in zip(read_minari(out, ()), dataset.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(ours.observations[""], theirs.observations)
        np.testing.assert_array_equal(ours.columns["rewards"][1:], theirs.rewards)
    again = there / "again-v0"
    run("export", tiny_run / "meta", "--out", again, "--episodes", EPISODES, "-q")
    for one, other in zip(dataset.iterate_episodes(), minari.load_dataset("again-v0").iterate_episodes(), strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)


def test_what_cannot_be_exported_is_one_line(tiny_run: Path, there: Path) -> None:
    """Spec G2: nothing half-written, nothing replaced."""
    (there / "there-v0").mkdir(parents=True)
    (there / "there-v0" / "mine").write_text("mine")
    refuses("Give --out DIR/NAME-v0", "export", tiny_run / "meta", "--out", there / "toy")
    refuses("what is there is not of kind", "export", tiny_run / "meta", "--out", there / "there-v0")
    refuses("Move it away", "export", tiny_run / "meta", "--out", there / "there-v0", "--force")
    refuses("no artefact here", "export", tiny_run, "--out", there / "x-v0")
