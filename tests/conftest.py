"""One thread per process, as the stages do it: two threads with a busy neighbour are ten times slower."""

import os
import signal
from collections.abc import Iterator

os.environ["OMP_NUM_THREADS"] = "1"
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background: tests of Ctrl-C would wait for ever
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def few_states_to_browse() -> Iterator[None]:
    """Evaluations explain 10 states instead of 120, which takes most of their time, and show 60 instead of 300."""
    from hypogoal.evaluation import explorer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(explorer, "MOST_STATES", 60)
        patch.setattr(explorer, "MOST_EXPLAINED", 10)
        yield


@pytest.fixture
def small_gru(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's option networks with a GRU of 32 units instead of 512: 10.5 M parameters each say no more."""
    from hypogoal.options.networks import PaperQNetwork

    monkeypatch.setattr(PaperQNetwork, "HIDDEN", 32)
