"""The study of other ways to members with features of their own."""

import numpy as np
import torch
from torch import nn

from hypogoal.core.seeding import rng_for
from hypogoal.which_feature.states import labelled_states
from studies.ways import WithUnlabelledGradients, least_alike, without_form, without_hue, without_number, without_place

PICTURES = labelled_states(64, 1).observations


def test_an_invariance_takes_one_feature_and_leaves_the_others() -> None:
    """Hues lose their channel, not their shades; tiles their place, not their pixels; some go, whole; edges blur."""
    rng = rng_for(0, "invariances")
    red = (PICTURES[..., 0] > PICTURES[..., 1]) & (PICTURES[..., 2] == 0)
    mixed = without_hue(PICTURES, rng)
    assert np.array_equal(np.sort(mixed), np.sort(PICTURES))
    assert np.ptp(mixed[red].mean(0)) < 0.2 * np.ptp(PICTURES[red].mean(0))
    moved = without_place(PICTURES, rng)
    assert np.array_equal(moved.sum((1, 2)), PICTURES.sum((1, 2)))
    assert not np.array_equal(moved, PICTURES)
    shown = without_number(PICTURES, rng)
    assert 0.4 < (shown == PICTURES)[:, ::8, ::8].all(-1)[:, 0].mean() < 0.6  # tiles of the wall, never black
    assert set(np.unique(shown[shown != PICTURES])) == {0}
    steps = [np.abs(np.diff(each.astype(float), axis=2)).max() for each in (PICTURES, without_form(PICTURES, rng))]
    assert steps[1] < 0.25 * steps[0]


def test_the_members_kept_agree_least_among_those_that_fit_the_labels() -> None:
    """Member 2 differs most but is wrong on the labels; of the others 1 and 3 agree on one state of four."""
    labels = np.array([True, False] * 10)
    on_labelled = np.repeat(labels[:, None], 4, axis=1)
    on_labelled[:, 2] = ~labels
    on_unlabelled = np.array([[1, 1, 0, 1], [0, 0, 1, 1], [1, 1, 0, 0], [0, 1, 1, 0]], np.bool_)
    assert least_alike(on_labelled, labels, on_unlabelled, 2) == [1, 3]
    assert 2 in least_alike(on_labelled, labels, on_unlabelled, 4)


def test_gradients_are_those_at_unlabelled_states() -> None:
    """Of a network that squares its pixels, so that they tell at which states they were taken."""

    class Squares(nn.Module):
        def forward(self, inputs: torch.Tensor) -> torch.Tensor:
            return inputs.square().sum((1, 2, 3))[:, None] * torch.tensor([0.0, 0.5])

    network = nn.Sequential(Squares())
    labels = np.arange(32) % 2 == 0
    states = WithUnlabelledGradients(PICTURES[:32], labels, PICTURES[32:], network, torch.device("cpu"))
    gradients = states.input_gradients([network], np.array([3, 5]))[0]
    expected = torch.from_numpy(PICTURES[[35, 37]]).permute(0, 3, 1, 2).flatten(1) / 255.0
    assert torch.allclose(gradients, expected)
