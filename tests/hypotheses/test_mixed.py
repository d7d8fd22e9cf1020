"""Observations of several cameras and numbers, from arrays to a report, and in other programs (Spec H6, I6)."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import torch
from command_line import FIXED, refuses, run, settings, trusting
from stable_baselines3 import PPO

import hypogoal
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.hypotheses.networks import as_input, build_network, inputs_of, network_for
from hypogoal.hypotheses.views import FullView, StateOrigins
from hypogoal.observations import packed, type_of, type_text
from tests.mixed import FRONT, GOAL, STATE, WRIST, DoorEnv, arrays, states


def test_a_file_keeps_each_key(mixed_run: Path) -> None:
    """Spec A8, H6: as a compound that h5py reads without hypogoal, one field a key."""
    wanted = arrays()
    with h5py.File(mixed_run / "data.h5") as file:
        seen = file[f"labelled/{GOAL}/observations"]
        for key in ("front", "wrist", "state"):
            np.testing.assert_array_equal(seen[key], wanted[f"observations/{key}"])
    data = open_dataset(mixed_run / "data.h5")
    assert type_of(type_text(data.observation_dtype)) == data.observation_dtype
    assert data.observation_bytes == np.prod(FRONT) + np.prod(WRIST) + 16
    assert data.features() == ["front", "state[0]", "state[1]", "state[2]", "state[3]", "wrist"]
    run("verify", mixed_run)


def test_each_key_has_its_encoder(mixed_run: Path) -> None:
    """Spec C5, H6: pictures the picture network, numbers the mlp; a name for one key, or for all pictures."""
    dtype = open_dataset(mixed_run / "data.h5").observation_dtype
    assert network_for("auto", (), dtype) == "front=doorkey,state=mlp,wrist=doorkey"
    assert network_for("tiles,wrist=montezuma", (), dtype) == "front=tiles,state=mlp,wrist=montezuma"
    with pytest.raises(UserError, match="no such key in the observations: arm"):
        network_for("arm=tiles", (), dtype)
    ensemble = hypogoal.load_ensemble(mixed_run / "ensemble", GOAL)
    assert ensemble.network == "front=doorkey,state=mlp,wrist=doorkey"
    seen, labels = states(30, 5)
    assert ((ensemble.predictions(seen) == labels[:, None]).mean(0) > 0.9).all()
    odd = {**seen, "state": seen["state"][:, :3]}
    for wrong in (odd, {key: seen[key] for key in ("front", "wrist")}, seen["front"]):
        with pytest.raises(UserError, match="these observations do not fit the ensemble"):
            ensemble.predict(wrong)


def test_a_network_sees_what_the_keys_hold() -> None:
    """Bytes of a mixed state, in whatever row, become the same inputs as each key's own array."""
    seen, _ = states(5)
    mixed = packed(seen)
    inputs = inputs_of(mixed)
    assert inputs.shape == (5, np.prod(FRONT) + np.prod(WRIST) + 4)
    for key in ("front", "state", "wrist"):
        own = as_input(torch.from_numpy(seen[key])).flatten(1)
        first = {"front": 0, "state": np.prod(FRONT), "wrist": np.prod(FRONT) + 4}[key]
        torch.testing.assert_close(inputs[:, first : first + own.shape[1]], own, rtol=0, atol=0)
        one = inputs_of(mixed[3:4])
        torch.testing.assert_close(one, inputs[3:4], rtol=0, atol=0)
    view = FullView((), mixed.dtype)
    view.fit(mixed, mixed[:0], StateOrigins(), 0)
    np.testing.assert_allclose(view.see(mixed)["state"].mean(0), 0, atol=1e-5)
    np.testing.assert_array_equal(view.see(mixed)["front"], seen["front"])


def test_a_joint_network_uses_every_key(mixed_run: Path) -> None:
    """A change in any key changes the logits."""
    dtype = open_dataset(mixed_run / "data.h5").observation_dtype
    network = build_network("auto", (), torch.Generator().manual_seed(0), dtype=dtype).eval()
    mixed = packed(states(4)[0])
    with torch.no_grad():
        before = network(inputs_of(mixed))
        for key in dtype.names or ():
            other = mixed.copy()
            other[key] = other[key][::-1]
            assert not torch.allclose(network(inputs_of(other)), before, atol=1e-7)


def test_attributions_are_by_key_and_complete(mixed_run: Path) -> None:
    """Spec F2: a field for each key; over all keys they add up to the difference in log-odds."""
    ensemble = hypogoal.load_ensemble(mixed_run / "ensemble", GOAL)
    seen, others = states(4)[0], states(6, 1)[0]
    values = ensemble.attributions(packed(seen), packed(others))
    assert values["front"].shape == (4, 2, *FRONT) and values["state"].shape == (4, 2, *STATE)
    sums = sum(values[key].reshape(4, 2, -1).sum(-1) for key in values.dtype.names)
    positive, negative = sums[1::2].mean(), sums[::2].mean()
    assert positive > 1 > negative
    patch = np.abs(values["front"][1])[:, 8:40, 20:44].sum()
    assert patch > np.abs(values["wrist"][1]).sum(), "the wrist camera shows nothing"


def test_evaluation_and_report(mixed_run: Path, tmp_path: Path) -> None:
    """Spec A2, A5, F1, F2: hypotheses are trained; scores, and bars of numbers and of whole pictures."""
    made = shutil.copytree(mixed_run, tmp_path / "run")
    run("evaluate", made, "-q")
    members = pd.read_csv(made / "evaluation" / "tables" / "hypotheses.csv").set_index("quantity")["mean"]
    assert members["worst"] > 0.9
    run("report", made, "-q")
    page = (made / "report" / "index.html").read_text(encoding="utf-8")
    assert 'id="figure-features"' in page


def test_an_agent_learns_from_cameras_and_numbers(mixed_run: Path) -> None:
    """Spec D1, I6: stable-baselines3's MultiInputPolicy, rewarded by the members alone, opens the door."""
    reward = hypogoal.SubgoalReward(mixed_run / "ensemble", by="any")
    env = reward.wrap(DoorEnv(), ends=False)
    learner = PPO("MultiInputPolicy", env, n_steps=64, batch_size=32, learning_rate=1e-3, seed=0, gamma=0.5)
    learner.learn(256)
    observation, _ = env.reset(seed=1)
    earned = 0.0
    for _ in range(8):
        observation, paid, *_ = env.step(int(learner.predict(observation, deterministic=True)[0]))
        earned += float(paid)
    assert earned >= 7


def test_options_say_that_they_cannot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec G2: agents see one kind; the line says what does learn from both."""
    (tmp_path / "doors.py").write_text(
        "from hypogoal import GymnasiumDomain\nfrom tests.mixed import DoorEnv\n"
        "DOMAIN = GymnasiumDomain(DoorEnv, {'door-open': lambda env: env.unwrapped.open})\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    few = settings("steps=40", "heldout_seeds=4", "unlabelled_seeds=1")
    run("check", "doors:DOMAIN", *few)
    run("collect", "doors:DOMAIN", "--out", tmp_path / "d.h5", "-q", *few)
    with trusting():
        few = settings("steps=2", "members=2", *FIXED)
        run("train-ensemble", tmp_path / "d.h5", "--out", tmp_path / "e", "-q", *few)
        words = ["train-options", tmp_path / "e", "--out", tmp_path / "o", "-q"]
        refuses("agents see pictures or numbers, not both: front, state, wrist. Reward", *words)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    "text", ["{}", '{"a": ["uint8", []], "..": ["uint8", [1]]}', '{"a": ["object", [1]]}', "[1]", "{"]
)
def test_a_type_that_no_file_has_is_refused(text: str) -> None:
    """Spec G2, H8: what a file says of its types is checked."""
    with pytest.raises(ValueError, match=r"."):
        type_of(text)


def exported(folder: Path) -> Any:
    """The function ``load`` of an exported folder, from its own file."""
    path = folder / "load.py"
    found: dict[str, Any] = {"__name__": "load", "__file__": str(path)}
    exec(compile(path.read_text(), path, "exec"), found)
    return found["load"]


@pytest.fixture(scope="module")
def pictures_hub(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Members of pictures alone, exported: in ``hub``, from ``ensemble``."""
    folder = tmp_path_factory.mktemp("pictures")
    seen, labels = states(24)
    pictures = seen["wrist"]
    pictures[labels, :20] = 255
    np.savez(folder / "s.npz", observations=pictures, labels=labels, unlabelled=255 - pictures)
    run("import", folder / "s.npz", "--out", folder / "d.h5", "--sub-goal", GOAL, "-q")
    few = settings("steps=4", "members=2", "workers=1", "diversity=none", "network=tiles")
    run("train-ensemble", folder / "d.h5", "--out", folder / "ensemble", "-q", *few)
    run("export", folder / "ensemble", "--out", folder / "hub")
    return folder


AS_THEY_ARE: list[Any] = [
    lambda some: list(some),
    lambda some: some[:, ::-1].copy()[:, ::-1],
    lambda some: torch.from_numpy(some),
]
OTHERS: list[Any] = [
    lambda some: some / 255,
    lambda some: some.astype(np.float32),
    lambda some: torch.from_numpy(some) / 255,
    lambda some: some[0],
    lambda some: some.transpose(0, 3, 1, 2),
    lambda some: some[:, :40],
]


def test_an_exported_folder_takes_what_members_take(pictures_hub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec I6: the same of flipped views, lists, tensors, whatever torch's defaults; anything else is one line."""
    ensemble = hypogoal.load_ensemble(pictures_hub / "ensemble", GOAL)
    pictures = states(6, 7)[0]["wrist"]
    wanted = ensemble.predict(pictures)
    load = exported(pictures_hub / "hub")
    torch.set_default_dtype(torch.float64)
    try:
        predict = load(GOAL)
        np.testing.assert_allclose(predict(pictures).numpy(), wanted, atol=1e-5)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        for given in AS_THEY_ARE:
            np.testing.assert_allclose(predict(given(pictures)).numpy(), wanted, atol=1e-5)
    for change in OTHERS:
        with pytest.raises(ValueError, match=r"each \(torch.uint8, 44, 44, 3\)"):
            predict(change(pictures))


def test_an_exported_folder_of_several_keys_names_the_wrong_one(mixed_run: Path, tmp_path: Path) -> None:
    """Spec I6: pictures that are divided already."""
    run("export", mixed_run / "ensemble", "--out", tmp_path / "hub")
    predict = exported(tmp_path / "hub")(GOAL)
    seen, _ = states(4)
    with pytest.raises(ValueError, match=r"front is \(torch.float64, 48, 64, 3\)"):
        predict({**seen, "front": seen["front"] / 255})


LOADER = """
import sys
sys.modules["hypogoal"] = None
sys.path.insert(0, sys.argv[1])
import numpy, torch
from load import load
with numpy.load(sys.argv[2]) as arrays:
    torch.save(load("door-open")({key: arrays[key] for key in ("front", "wrist", "state")}), sys.argv[3])
print(sorted(name for name in ("numpy", "gymnasium", "h5py", "stable_baselines3") if name in sys.modules))
"""


def test_a_folder_for_a_hub_loads_without_hypogoal(mixed_run: Path, tmp_path: Path) -> None:
    """Spec I6: in a process that has torch and safetensors; the same probabilities."""
    hub = tmp_path / "hub"
    run("export", mixed_run / "ensemble", "--out", hub)
    assert {file.name for file in hub.iterdir()} == {
        "README.md", "config.json", f"{GOAL}.safetensors", "load.py", "manifest.json",
    }  # fmt: skip
    seen, _ = states(6, 7)
    np.savez(tmp_path / "seen.npz", **seen)
    words = [sys.executable, "-c", LOADER, str(hub), str(tmp_path / "seen.npz"), str(tmp_path / "p.pt")]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path, env={"PATH": ""})
    assert done.stdout.strip() == "['numpy']"
    wanted = hypogoal.load_ensemble(mixed_run / "ensemble", GOAL).predict(seen)
    np.testing.assert_allclose(torch.load(tmp_path / "p.pt", weights_only=True).numpy(), wanted, atol=1e-5)
    run("export", mixed_run / "ensemble", "--out", hub, "--force")
