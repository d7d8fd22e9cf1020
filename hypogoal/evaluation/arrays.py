"""What ``arrays.h5`` holds of an evaluation: the arrays that figures and pictures of the report are drawn from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.hdf5 import fixed
from hypogoal.dataset import Split
from hypogoal.evaluation.agents import Run, agent_curves, common_grid
from hypogoal.evaluation.distance import Executions, fates
from hypogoal.evaluation.saliency import Attributions

WHERE = {0: "unseen", 1: "unlabelled data from it", 2: "labelled data from it"}  # values of the origin ``seen``


def write_curves(arrays: Any, groups: Mapping[str, list[Run]]) -> None:
    """Figure 6: ``curves/grid`` and ``curves/<agent's index>/{reward,success,length}``, float (runs, grid)."""
    grid = common_grid([run for same in groups.values() for run in same])
    arrays["curves/grid"] = grid
    for index, same in enumerate(groups.values()):
        for key, values in agent_curves(same, grid).items():
            arrays[f"curves/{index}/{key}"] = values


def write_states(
    group: Any,
    picked: Sequence[tuple[int, str]],
    split: Split,
    probabilities: NDArray[np.float32],
    verdicts: NDArray[np.bool_],
) -> None:
    """Held-out states, what members say of them, and where they are from.

    Args:
        group: gets ``observations``, ``labels`` and ``layout_seeds`` (-1: none) (n,), ``probabilities`` and
            ``verdicts`` (n, K), and as JSON lists of n texts ``kinds`` and ``places``.
        picked: n times (index in the split, kind).
        split: N states.
        probabilities, verdicts: (N, K) each.
    """
    index = np.array([index for index, _ in picked], dtype=np.int64)
    group["observations"] = split.observations[index]
    group["probabilities"] = probabilities[index]
    group["verdicts"] = verdicts[index]
    group["labels"] = split.labels[index]
    seeds = split.origins.get("layout_seed")
    group["layout_seeds"] = seeds[index] if seeds is not None else np.full(len(index), -1)
    group["kinds"] = fixed(json.dumps([kind for _, kind in picked]))
    group["places"] = fixed(json.dumps([place_of(split.origins, state) for state in index]))


def place_of(origins: Mapping[str, NDArray[np.int64]], state: int) -> str:
    """Where a state is from, in words; nothing where no origin says it."""
    if "layout_seed" in origins:
        return f"layout {origins['layout_seed'][state]}"
    if "room" not in origins:
        return ""
    seen = f" ({WHERE[int(origins['seen'][state])]})" if "seen" in origins else ""
    return f"room {origins['room'][state]}{seen}"


def write_attributions(group: Any, found: Attributions, seen: NDArray[np.uint8], baseline: NDArray[np.uint8]) -> None:
    """Figures 2 and 9: ``attributions`` float32 (n, K, h, w, C), in log-odds, to what members saw.

    Args:
        group: also gets ``seen`` and ``baseline``.
        found: of n states.
        seen: uint8 (n, h, w, C), what members see of the states: all, or a window around the agent.
        baseline: uint8 (h, w, C).
    """
    group.create_dataset("attributions", data=found.values.astype(np.float32), compression="gzip", compression_opts=1)
    group["seen"] = seen
    group["baseline"] = baseline


def write_stops(arrays: Any, path: str, option: int, executions: Executions, pixel: Any) -> None:
    """Figure 5: ``stops/<options artefact>/<option>/{positions,pixels,fates}``.

    Args:
        arrays: the file.
        path: the artefact.
        option: its option.
        executions: the last ones of that option.
        pixel: the domain's: positions (n, 3) -> pixels (n, 2) of the room's picture.
    """
    group = arrays.require_group(f"stops/{path}/{option}")
    if len(group):
        return  # the oracle's stand beside every N
    group["positions"] = executions.positions()
    group["pixels"] = np.asarray(pixel(executions.positions())).reshape(-1, 2)
    group["fates"] = fates(executions)
