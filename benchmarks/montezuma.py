"""Distinct labelled stacks per second: collecting Montezuma's Revenge against the emulator's ceiling, in one run.

    python -m benchmarks.montezuma [--short] [--json PATH]

The ceiling is what the emulator itself does: random actions in room 1, four frames, the maximum of two, the picture
made small and a stack of four, every 40 steps a saved state restored, and nothing is looked at. Made are distinct
stacks with their labels: the room entered, phases waited for, the expert's rollouts. Kept is what
``montezuma_states.gather`` gives, the whole of it: one in three distinct stacks is left to the held-out set, and of
what is left a choice is made by kinds.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.doorkey import machine
from hypogoal.dataset import digest
from hypogoal.domains.montezuma_emulator import N_ACTIONS, Emulator, Position
from hypogoal.domains.montezuma_ladders import LADDERS
from hypogoal.domains.montezuma_states import Shown, emulator_of_process, expert_play, gather, labels_of
from hypogoal.domains.montezuma_sub_goals import CLIMB_DOWN

WANTED_RATE = 700  # made
ROOMS = (1, 6, 9, 12, 18, 22)  # three ladders; one; one and snakes; lasers; lava; lava and one
RESTORE_EVERY = 40


class Timing(NamedTuple):
    """One room in one repeat: the emulator's agent steps/s, stacks/s made and kept, of CPU time; positives kept."""

    ceiling: float
    made: float
    kept: float
    positives: int


def make(room: int, count: int, seed: int) -> int:
    """Distinct stacks of the expert's rollouts, with their labels, until there are so many; positives among them."""
    rng = np.random.default_rng(seed)
    found: dict[bytes, Shown] = {}
    for shown in expert_play(emulator_of_process(), room, rng, [CLIMB_DOWN]):
        found.setdefault(digest(shown.stack), shown)
        if len(found) == count:
            break
    return int(labels_of(np.stack([shown.ram for shown in found.values()]), [CLIMB_DOWN]).sum())


def time_ceiling(emulator: Emulator, start: Position, actions: list[int]) -> float:
    """Agent steps per second of CPU time, with an observation at each."""
    state = emulator.place(*start)
    assert state is not None
    begin = time.process_time()
    for step, action in enumerate(actions):
        if step % RESTORE_EVERY == 0:
            emulator.restore(state)
        emulator.step(action)
        _observation = emulator.stack
    return len(actions) / (time.process_time() - begin)


def time_room(room: int, states: int, seed: int) -> Timing:
    """Collect labelled states of a room, the ceiling measured before and after."""
    actions = np.random.default_rng(seed).integers(N_ACTIONS, size=states).tolist()
    before = time_ceiling(emulator_of_process(), LADDERS[0].top, actions)
    begin = time.process_time()
    make(room, states, seed)
    made = time.process_time() - begin
    begin = time.process_time()
    found = gather(room, states, seed, ("benchmark",), sub_goals=[CLIMB_DOWN], held_out=False, unclear=False)
    kept = time.process_time() - begin
    after = time_ceiling(emulator_of_process(), LADDERS[0].top, actions)
    return Timing(
        statistics.mean((before, after)), states / made, states / kept, int(labels_of(found.ram, [CLIMB_DOWN]).sum())
    )


def summary(name: str, timings: list[Timing]) -> dict[str, Any]:
    """Medians over the timings, and the lowest and highest rate of what is made."""
    made = [timing.made for timing in timings]
    return {
        "name": name,
        "ceiling_steps_per_second": statistics.median(timing.ceiling for timing in timings),
        "made_per_second": statistics.median(made),
        "lowest": min(made),
        "highest": max(made),
        "made_per_ceiling": statistics.median(timing.made / timing.ceiling for timing in timings),
        "kept_per_second": statistics.median(timing.kept for timing in timings),
        "kept_per_ceiling": statistics.median(timing.kept / timing.ceiling for timing in timings),
        "positives": statistics.median(timing.positives for timing in timings),
    }


def main() -> None:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.montezuma", description=__doc__.split("\n")[0])
    parser.add_argument("--short", action="store_true", help="a few seconds, for continuous integration")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    repeats, states, rooms = (1, 150, ROOMS[:2]) if arguments.short else (3, 600, ROOMS)
    timings = {room: [time_room(room, states, seed) for seed in range(repeats)] for room in rooms}
    results = [summary(f"room {room}", repeated) for room, repeated in timings.items()]
    results.append(summary("all rooms", [timing for repeated in timings.values() for timing in repeated]))
    about = {**machine(), "ale-py": metadata.version("ale-py")}
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"{states} distinct labelled stacks uint8 (84, 84, 4) of a room, CPU time of one process, {repeats} repeats")
    print(
        f"{'':10}{'ceiling':>8}{'made/s':>8}{'lowest':>8}{'highest':>9}{'ratio':>7}{'kept/s':>8}{'ratio':>7}{'positives':>11}"
    )
    for row in results:
        print(
            f"{row['name']:10}{row['ceiling_steps_per_second']:8,.0f}{row['made_per_second']:8,.0f}{row['lowest']:8,.0f}"
            f"{row['highest']:9,.0f}{row['made_per_ceiling']:7.2f}{row['kept_per_second']:8,.0f}"
            f"{row['kept_per_ceiling']:7.2f}{row['positives']:11,.0f}"
        )
    print("ceiling: the emulator's agent steps/s, measured before and after; ratio: to that")
    print(f"made: with labels, before the held-out ones and the choice by kinds; wanted: {WANTED_RATE} stacks/s")
    if arguments.json:
        record = {"machine": about, "repeats": repeats, "states": states, "results": results}
        arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
