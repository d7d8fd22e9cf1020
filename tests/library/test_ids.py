"""The environments' ids with Gymnasium, in fresh interpreters (Spec B1)."""

import json
import subprocess
import sys

import pytest

MADE = "print(gymnasium.make({id!r}).observation_space.shape)"
PLAIN, NAMED = "hypogoal/DoorKey-8x8-v0", "hypogoal.envs:hypogoal/DoorKey-8x8-v0"
CHANGES = """
import json, os, signal, sys, warnings
import torch
handled = signal.SIGINT, signal.SIGTERM
def state():
    process = [*sys.meta_path], {**os.environ}, [*map(signal.getsignal, handled)], torch.random.initial_seed()
    return process, torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
before, filters, modules = state(), [*warnings.filters], {*sys.modules}
import hypogoal
heavy = sorted({"gymnasium", "h5py", "typer"} & ({*sys.modules} - modules))
same = [filters == warnings.filters, before == state()]
hypogoal.OptionEnv
print(json.dumps([*same, before == state(), heavy]))
"""


def printed(code: str) -> str:
    """What a fresh interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("imports", "name"),
    [
        ("import gymnasium", NAMED),  # of a process that never imported hypogoal
        ("import gymnasium, hypogoal", PLAIN),
        ("import hypogoal, gymnasium; hypogoal.UserError", PLAIN),
    ],
)
def test_an_environment_is_made_by_its_id(imports: str, name: str) -> None:
    """Gymnasium's ``module:id`` always works, the bare id once hypogoal is imported after Gymnasium, or used."""
    assert printed(f"{imports}\n{MADE.format(id=name)}") == "(64, 64, 3)"


def test_importing_hypogoal_changes_nothing_in_its_users_process() -> None:
    """No finder, variable, handler, filter or setting of torch, then and once its parts are used; nothing is loaded."""
    assert json.loads(printed(CHANGES)) == [True, True, True, []]
