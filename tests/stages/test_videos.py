"""Spec D1, D6, E1, F7: an agent's episode out of its saved artefacts, and what is drawn of it."""

import io
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors, save_tensors
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.episodes import agent_of, play_episode
from hypogoal.stages.collect import collect
from hypogoal.stages.report import agents_of, play_films
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_meta import train_meta

QUIET = {"quiet": True}
CAP, TIMEOUT, MEMBERS = 30, 7, 2


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An agent, barely trained, and the random chooser beside it."""
    run = tmp_path_factory.mktemp("runs") / "watched"
    collect(DOMAIN, DoorKeyConfig(heldout_layouts=1, unlabelled_seeds=(1,)), run / "data.h5", **QUIET)
    few = TrainEnsembleConfig(steps=10, members=MEMBERS, workers=1)
    train_ensemble(run / "data.h5", few, run / "ensemble", **QUIET)
    short = TrainMetaConfig(
        steps=640, max_episode_steps=CAP, option_timeout=TIMEOUT, random_episodes=1, layout_seed=100, warm_up=100
    )
    train_meta(run / "ensemble", short, run / "meta", **QUIET)
    train_meta(run / "ensemble", replace(short, chooser="random"), run / "meta-random", **QUIET)
    return run


@pytest.fixture(scope="module")
def frames(run):
    played = [play_episode(agent_of(open_artefact(run / "meta"), seed=3), MEMBERS) for _ in range(2)]
    for first, second in zip(*played, strict=True):
        assert (first.option, first.step, first.ended) == (second.option, second.step, second.ended)
    return played[0]


def test_an_episode_is_whole(frames):
    """Spec D1: every step once, from 0 to the cap or the goal; each execution's time runs down by one a step."""
    running = [frame for frame in frames if not frame.ended]
    assert [frame.step for frame in running] == list(range(len(running)))
    assert frames[-1].ended and frames[-1].step == len(running) <= CAP
    for before, after in pairwise(frames):
        if before.ended:
            assert after.left == TIMEOUT
            assert after.step == before.step
            np.testing.assert_array_equal(after.observation, before.observation)
        else:
            assert (after.left, after.option, after.step) == (before.left - 1, before.option, before.step + 1)
    for frame in frames:
        if frame.ended == "its time is up":
            assert frame.left == 0 and not frame.predictions[frame.option % MEMBERS]
        if frame.ended == "its classifier is positive":
            assert frame.predictions[frame.option % MEMBERS]


def test_predictions_are_those_of_the_sub_goals_members(run, frames):
    """Spec D1, D6: recomputed here from the pictures and the weights."""
    source = open_artefact(run / "ensemble")
    for goal in {frame.option // MEMBERS for frame in frames}:
        alike = [frame for frame in frames if frame.option // MEMBERS == goal]
        ensemble = read_ensemble(source.path, source.config, source.config["sub_goals"][goal])
        says = ensemble.predictions(np.stack([frame.observation for frame in alike]))
        assert says.tolist() == [list(frame.predictions) for frame in alike]


def test_videos_are_of_the_agents_that_choose(run):
    """Spec E1, F7: of the one that learned to choose, not of the random chooser; a frame for each of the episode's."""
    agents = agents_of(run)
    assert [artefact.path.name for artefact in agents] == ["meta"]
    films = play_films(agents, run, 2)
    assert [film.name for film in films] == ["meta-episode-0.gif", "meta-episode-1.gif"]
    with Image.open(io.BytesIO(films[0].gif)) as video:
        assert video.format == "GIF"
        assert 2 < video.n_frames <= 2 * CAP + 1
        assert video.size[0] == 320


def test_weights_of_another_policy_are_one_line(run, tmp_path):
    """Spec G2: weights of a meta-policy that do not fit."""
    artefact = open_artefact(run / "meta")
    meta = load_tensors(artefact.path / "meta.safetensors")
    copied = shutil.copytree(artefact.path, tmp_path / "meta")
    save_tensors(copied / "meta.safetensors", dict(list(meta.items())[1:]))
    with pytest.raises(UserError, match="do not fit"):
        agent_of(replace(artefact, path=copied), seed=0)
