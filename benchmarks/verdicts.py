"""Verdicts of fifteen members on new states of a grid world, in one run, one thread.

    python -m benchmarks verdicts [--short] [--json PATH]

New states come from random play on DoorKey, one to four at a time, each once, as a training's loop meets them. The
reference computes windows that are not known yet as the library's convolutions, four at a time; beside it what becomes
of them where nothing is kept, and where each ensemble predicts by itself.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks import timing

timing.alone()

import numpy as np  # noqa: E402
import torch  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from torch import Tensor  # noqa: E402

from hypogoal.core.compute import prepare  # noqa: E402
from hypogoal.domains.doorkey_engine import DoorKeyEngine  # noqa: E402
from hypogoal.hypotheses.ensemble import Ensemble  # noqa: E402
from hypogoal.hypotheses.known_windows import KnownWindows  # noqa: E402
from hypogoal.hypotheses.networks import as_input  # noqa: E402
from hypogoal.hypotheses.stacked import StackedMembers  # noqa: E402

LAYOUT, ENSEMBLES, MEMBERS = 100, 5, 3
KNOWN = "known windows"
WANTED = {KNOWN: 1.25}


class Convolved(KnownWindows):
    """New windows as convolutions, four at a time, at places that their pixels determine."""

    compute: Callable[[Tensor], Tensor]

    def _learn(self, windows: Sequence[bytes], first: int, channels: int) -> None:
        left = {first + index: zlib.crc32(window) % 4 for index, window in enumerate(windows)}
        while left:
            rows = {place: row for row, place in left.items()}
            pixels = np.zeros((4, self.side, self.side, channels), dtype=np.uint8)
            for place, row in rows.items():
                pixels[place] = np.frombuffer(windows[row - first], dtype=np.uint8).reshape(pixels.shape[1:])
                del left[row]
            outputs = self.compute(as_input(torch.from_numpy(pixels))).flatten(1)
            for place, row in rows.items():
                self._keep(row, outputs[place])


def new_states(count: int) -> list[NDArray[np.uint8]]:
    """Images of states as random play first meets them, in batches of those that a joint step brings."""
    engine, rng, seen = DoorKeyEngine(LAYOUT, 16), np.random.default_rng(0), set[int]()
    engine.reset()
    batches = []
    while len(seen) < count:
        ids = np.unique(engine.step(rng.integers(engine.n_actions, size=16)).next_ids)
        new = [int(state) for state in ids if int(state) not in seen]
        seen.update(new)
        if new:
            batches.append(engine.images(np.array(new)))
    return batches


def judged(members: StackedMembers, batches: list[NDArray[np.uint8]]) -> float:
    """CPU seconds of a call, nothing known before the first."""
    if members._windows is not None:
        members._windows._rows.clear()
    return timing.cpu_seconds(lambda: [members.log_odds(batch) for batch in batches]) / len(batches)


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "verdicts")
    repeats, count = (1, 100) if given.short else (7, 1500)
    prepare()
    about = timing.machine("torch", "numpy")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    generator = torch.Generator().manual_seed(0)
    ensembles = [Ensemble("doorkey", (64, 64, 3), MEMBERS, generator).eval() for _ in range(ENSEMBLES)]
    batches = new_states(count)
    known, convolved, whole = (StackedMembers(ensembles, repeats=repeats) for repeats in (True, True, False))
    assert convolved._windows is not None
    windows = Convolved(convolved._steps[: convolved._first], convolved.count)
    windows.compute = lambda pixels: convolved._apply(0, convolved._first, pixels)
    convolved._windows = windows
    np.testing.assert_allclose(known.log_odds(batches[0]), convolved.log_odds(batches[0]), atol=1e-5)
    candidates: dict[str, Callable[[], float]] = {
        "windows as convolutions": lambda: judged(convolved, batches),
        KNOWN: lambda: judged(known, batches),
        "whole images": lambda: judged(whole, batches),
    }
    rows: list[dict[str, Any]] = timing.rows_of(
        timing.alternated(candidates, repeats), "windows as convolutions", WANTED
    )
    timing.show(f"\na call, {sum(map(len, batches)) / len(batches):.1f} new states, 15 members", rows)
    timing.write(given.json, about, {"calls": rows, "repeats": repeats})


if __name__ == "__main__":
    main()
