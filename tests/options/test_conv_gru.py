"""The paper's network and its learner: windows of an execution, in learning, acting, out of files (Spec D2, D3)."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from corridor import Corridor, LongCorridor
from option_loops import loop_of

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import below
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.options import double_dqn
from hypogoal.options.conv_gru import Lived, PaperPolicies
from hypogoal.options.loop import OptionLoop
from hypogoal.options.paper_network import PaperQNetwork, ProductsOfPlaces
from hypogoal.options.saved import SavedOptions

STAY = 0
OWN = {"network": "paper", "experience": "own", "mask_reached": False, "replay": 100}


def paper(engine: Any, **settings: Any) -> OptionLoop:
    """Options of the paper's network on the engine."""
    few = {"environments": engine.count, "option_batch": 4, "update_interval": 4}
    return loop_of(engine, **OWN | few | settings)


def lived(paths: list[list[int]], recurrence: int) -> Lived:
    """Steps of executions through these states, the last of which came next."""
    kept = [path[-recurrence - 1 :] for path in paths]
    rows = [path + path[-1:] * (recurrence + 1 - len(path)) for path in kept]
    lengths = [min(len(path) - 1, recurrence) for path in paths]
    return Lived.cast(np.array(rows), lengths, [0] * len(paths), [False] * len(paths))


@pytest.mark.usefixtures("small_gru")
def test_windows_of_other_lengths_change_nothing() -> None:
    """A window beside longer ones is what it is alone, step by step by PyTorch's own cell."""
    torch.manual_seed(0)
    images = torch.from_numpy(DoorKeyEngine(100, 1).images(np.arange(5)))
    network = PaperQNetwork((64, 64, 3), 7).eval()
    windows, lengths = torch.tensor([[0, 1, 2, 3], [4, 2, 2, 2], [1, 1, 0, 0]]), torch.tensor([4, 2, 3])
    with torch.no_grad():
        features = network.features(images.permute(0, 3, 1, 2) / 255.0).flatten(1)
        seen = network.see(images)
        together = network(seen, windows, lengths)
        cell = torch.nn.GRUCell(features.shape[1], network.HIDDEN)
        weights = below("gru.", network.tensors())
        cell.load_state_dict({name.removesuffix("_l0"): value for name, value in weights.items()})
        for row, length, values in zip(windows, lengths, together, strict=True):
            real = row[:length]
            alone = network(network.see(images[real]), torch.arange(len(real))[None], length[None])
            torch.testing.assert_close(alone[0], values, atol=1e-5, rtol=0)
            state = torch.zeros(1, network.HIDDEN)
            for feature in features[real]:
                state = cell(feature[None], state)
            torch.testing.assert_close(network.values(state)[0], values, atol=1e-5, rtol=0)
        shorter = network(seen, windows[:1, 1:], torch.tensor([3]))
    assert not torch.allclose(shorter[0], together[0], atol=1e-4), "what came before is of no account"


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("training", [True, False])
def test_distinct_patches_give_what_whole_images_give(training: bool) -> None:
    """Values, gradients and BatchNorm's statistics are those of the plain computation."""
    torch.manual_seed(0)
    engine = DoorKeyEngine(100, 4)
    for _ in range(5):
        engine.step(np.array([0, 1, 2, 2]))
    images = engine.images(np.arange(engine.n_states))
    tabled = PaperQNetwork((64, 64, 3), 7).train(training)
    plain = copy.deepcopy(tabled).double()  # for torch's BatchNorm of so many places is off by 1e-3 in float32
    pixels = torch.from_numpy(images).permute(0, 3, 1, 2).double() / 255.0
    seen, weights = plain.features(pixels).flatten(1), plain.tensors()["gru.weight_ih_l0"]
    expected = torch.nn.functional.linear(seen, weights, plain.gru["bias_ih_l0"])
    found = tabled.see(tabled.pieces_of(images))
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-4)
    chosen = torch.randn(expected.shape)
    (expected * chosen).sum().backward()
    (found * chosen).sum().backward()
    for (name, weight), same in zip(plain.named_parameters(), tabled.parameters(), strict=True):
        if weight.grad is not None:
            scale = max(10.0, weight.grad.norm().item())  # that of a bias before BatchNorm is 0
            assert (same.grad - weight.grad).norm() <= 1e-4 * scale, name
    for one, two in zip(plain.buffers(), tabled.buffers(), strict=True):
        torch.testing.assert_close(two.to(one.dtype), one, rtol=0, atol=1e-6)


def test_products_of_places_are_those_of_a_loop() -> None:
    """Products and gradients are the same bytes as by PyTorch's own gradient of the loop over places."""
    torch.manual_seed(0)
    counts = [3, 1, 5]
    contents, looks = torch.randn(9, 4, requires_grad=True), torch.randn(3, 4, 6, requires_grad=True)
    wanted = torch.randn(9, 6)
    products = ProductsOfPlaces.apply(contents, looks, counts)
    found = torch.autograd.grad((products * wanted).sum(), [contents, looks])
    plain = torch.cat([rows @ weight for rows, weight in zip(contents.split(counts), looks, strict=True)])
    expected = torch.autograd.grad((plain * wanted).sum(), [contents, looks])
    assert torch.equal(products, plain)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_the_papers_sizes() -> None:
    assert sum(p.numel() for p in PaperQNetwork((64, 64, 3), 7).parameters()) == pytest.approx(10.5e6, rel=0.02)
    network = PaperQNetwork((84, 84, 4), 18)
    seen = network.see(torch.zeros(3, 84, 84, 4, dtype=torch.uint8))
    assert network(seen, torch.arange(3)[:, None], torch.ones(3, dtype=torch.int64)).shape == (3, 18)


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize(("recurrence", "states"), [(1, {4, 5}), (3, {2, 3, 4, 5}), (9, {1, 2, 3, 4, 5})])
def test_only_states_of_the_window_are_seen(recurrence: int, states: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """The last N of the execution and the one that came next; never what stands in the padding."""
    engine = Corridor(1)
    learner = paper(engine, recurrence=recurrence, option_batch=1).learner
    learner.members[0].replay.add(lived([[1, 2, 3, 4, 5]], recurrence))
    seen: set[int] = set()
    images = engine.images
    monkeypatch.setattr(engine, "images", lambda ids, *out: (seen.update(ids.tolist()), images(ids, *out))[1])
    learner._update(0, learner.members[0])
    assert seen == states


@pytest.mark.usefixtures("small_gru")
def test_what_is_stored_are_the_steps_of_the_execution() -> None:
    """Each with its window, also where executions end in between."""
    loop = paper(LongCorridor(2), recurrence=3, option_timeout=5, restart_options=True)
    steps: list[list[int]] = [[], []]
    wanted = []
    for _ in range(40):
        moved = loop.advance()
        for place in range(2):
            steps[place] = steps[place] or [int(moved.ids[place])]
            steps[place].append(int(moved.next_ids[place]))
            wanted.append((int(moved.options[place]), steps[place][-4:]))
            if moved.ended[place]:
                steps[place] = []
    for option, member in enumerate(loop.learner.members):
        data = member.replay.data
        found = [data.path[row, : data.length[row] + 1].tolist() for row in range(member.replay.size)]
        assert found == [path for chosen, path in wanted if chosen == option]


@pytest.mark.usefixtures("small_gru")
@pytest.mark.parametrize("recurrence", [1, 3])
def test_what_is_loaded_plays_the_same(recurrence: int) -> None:
    """Spec D2: outside an engine an execution sees what it saw in training, from its own first step on.

    So it does in another process, with all that it remembers.
    """
    loop = paper(LongCorridor(1), recurrence=recurrence, option_timeout=6, restart_options=True)
    learner, engine = loop.learner, loop.engine
    with torch.no_grad():  # larger weights, so that the action depends on the pictures
        for member in learner.members:
            for weight in member.online.parameters():
                weight.mul_(3.0)
    config = {"recurrence": recurrence, "sub_goals": ["end"], "members": 2}
    saved = SavedOptions(config, learner.weights(), engine.observation_shape)
    policies, played = pickle.loads(pickle.dumps(PaperPolicies(saved))), set()  # noqa: S301 - our own
    act = None
    for _ in range(40):
        if act is None:
            loop._choose(False)
            act = policies(int(loop.option[0]))
        wanted = act(engine.images(engine.ids)[0])
        moved = loop.advance(learning=False)
        assert moved.actions[0] == wanted
        played.add(wanted)
        act = None if moved.ended[0] else pickle.loads(pickle.dumps(act))  # noqa: S301
    assert len(played) > 1


@pytest.mark.usefixtures("small_gru")
def test_nothing_follows_on_a_positive_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec D1, D2: reward 1 there, and no value of what lies behind, though the episode goes on."""
    learner = paper(Corridor(1), recurrence=2).learner
    learner.members[0].replay.add(lived([[2, 1], [2, 1, 0]], 2))
    seen, targets = [], double_dqn.double_q_targets
    monkeypatch.setattr(double_dqn, "double_q_targets", lambda *of, **more: (seen.append(of), targets(*of, **more))[1])
    learner._update(0, learner.members[0])
    ((rewards, terminal, *_),) = seen
    assert set(rewards.flatten().tolist()) == {0.0, 1.0} and torch.equal(terminal, rewards == 1)


@pytest.mark.usefixtures("small_gru")
def test_what_a_seldom_chosen_member_stored_may_be_forgotten() -> None:
    """Spec D3: members share the engine's memory; windows that are gone are not learned from."""
    engine = LongCorridor(4, memory=300)
    learner = paper(engine, recurrence=4).learner
    for _ in range(20):
        states = engine.step(np.full(4, STAY)).next_ids
    for member in learner.members:
        member.replay.add(lived([states.tolist()], 4))
    assert learner._update(0, learner.members[0]).loss > 0.0
    for _ in range(100):
        states = engine.step(np.full(4, STAY)).next_ids
    learner.members[1].replay.add(lived([states.tolist()], 4))
    assert learner._update(0, learner.members[0]) is None
    assert learner._update(1, learner.members[1]).loss > 0.0


@pytest.mark.usefixtures("small_gru")
def test_what_it_cannot_learn_is_refused() -> None:
    """Spec D2, D3: others' experience, numbers, and a replay longer than the engine's memory."""
    with pytest.raises(UserError, match="experience=shared"):
        paper(Corridor(1), experience="shared")
    with pytest.raises(UserError, match=r"replay=1000\. Give --set replay="):
        paper(LongCorridor(4, memory=900), replay=1000)
