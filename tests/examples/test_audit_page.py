"""docs/audit.md begins with the reader's classifier: its blocks and commands run as they are written (Spec H5)."""

import json
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import run, settings, trusting
from test_docs import DOCS, blocks

from hypogoal.cli import main
from tests import mixed

PAGE = DOCS / "audit.md"
OF_MODULE, OF_LEROBOT = blocks(PAGE, "python")[:2]
WORDS = [shlex.split(line)[1:] for line in blocks(PAGE, "text")[0].splitlines()]
CELL = 8  # pixels
DOMAIN = """
from corridor_env import CorridorEnv, at_left
from hypogoal import GymnasiumDomain
DOMAIN = GymnasiumDomain(CorridorEnv, {"opened": at_left})
"""
# A torch module whose logit is high where the corridor's agent, which is white, is in a cell.
MODULE = """
import torch
class Network(torch.nn.Module):
    def forward(self, pictures):
        assert pictures.dtype == torch.float32 and pictures.max() <= 1 and not self.training
        return 10 * pictures[:, 0, 0, {column}] - 5
network = Network()
"""
# As LeRobot's published reward classifier is used: ``predict`` takes a list of cameras and gives logits and
# probabilities (N,) that need a gradient.
CLASSIFIER = """
from types import SimpleNamespace
import torch
from torch import nn
class Classifier(nn.Module):
    def __init__(self, keys):
        super().__init__()
        layers = lambda: nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Dropout(0.1), nn.Linear(48, 12))
        self.encoders = nn.ModuleDict({key: layers() for key in keys})
        self.head = nn.Linear(24, 1)
    def predict(self, cameras):
        encoded = [encoder(camera) for encoder, camera in zip(self.encoders.values(), cameras, strict=True)]
        logits = self.head(torch.hstack(encoded)).squeeze(-1)
        return SimpleNamespace(logits=logits, probabilities=torch.sigmoid(logits), hidden_states=encoded)
torch.manual_seed(0)
model = Classifier(["front", "wrist"]).eval()
def normalised(pictures, key):
    assert pictures.shape[1] == 3
    return (pictures - 0.45) / 0.25
"""


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with trusting():
        yield
    for name in ("my_reward", "my_network", "my_domain"):
        sys.modules.pop(name, None)


def written(block: str, network: str) -> None:
    """The page's file, and those of its reader that it needs."""
    for name, text in (("my_reward", block), ("my_network", network), ("my_domain", DOMAIN)):
        sys.modules.pop(name, None)
        Path(f"{name}.py").write_text(text, encoding="utf-8")


def of_continuous_integration() -> list[str]:
    """The words of the page's example, a folded block of YAML."""
    [example] = blocks(PAGE, "yaml")
    assert len(example.splitlines()) <= 10
    words = shlex.split(example.partition("run: >")[2])
    assert words[0] == "hypogoal"
    return words[1:]


@pytest.mark.parametrize(("cell", "code"), [(1, 3), (0, 0)])
def test_a_build_fails_by_the_module(cell: int, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 3 where the module says yes a cell too soon, else 0; one line of JSON; again where it is complete."""
    written(OF_MODULE, MODULE.format(column=CELL * cell))
    words = of_continuous_integration()
    quick = settings("steps=900", "environments=4", "warm_up=50", "epsilon_steps=300", "option_timeout=10", "mend=0")
    for resumed in ([], ["--resume"]):
        assert main([*words, *quick, "-q", *resumed]) == code
        told = json.loads(capsys.readouterr().out)
        assert (told["out"], told["failed"], told["fail_above"]) == (words[words.index("--out") + 1], code == 3, 0.05)
        shares = told["false_positives"]
        assert shares.keys() == {"policy", "play"}
        assert all((share > 0.05) == (code == 3) for share in shares.values())


@pytest.mark.parametrize(("block", "network"), [(OF_MODULE, MODULE.format(column=12)), (OF_LEROBOT, CLASSIFIER)])
def test_labels_by_hand_are_the_truth(block: str, network: str) -> None:
    """The page's second command, of one camera and of two."""
    written(block, network)
    arrays = mixed.arrays()
    if block == OF_MODULE:
        names = ("observations", "unlabelled", "heldout_observations")
        arrays |= {name: arrays[f"{name}/front"] for name in names}
        arrays = {name: values for name, values in arrays.items() if "/" not in name}
    np.savez("door.npz", **arrays)
    Path("data").mkdir()
    run("import", "door.npz", "--out", "data/door.h5", "--sub-goal", "opened", "-q")
    told = run(*WORDS[1])
    assert "of 28 known failures" in told.out and Path("runs/audit/index.html").is_file()
