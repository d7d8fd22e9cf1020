"""Distinct labelled states per second: collecting Montezuma's Revenge against the emulator's ceiling, in one run.

    python -m benchmarks.montezuma [--short] [--json PATH]

The ceiling is what the emulator itself does: random actions in room 1, four frames, the maximum of two, the picture
made small and a stack of four, every 40 steps a saved state restored, and nothing is looked at. Collecting is
``montezuma_states.gather``, the whole of it: entering the room, waiting for a phase, rollouts, labels, no stack twice,
one in three stacks left to the held-out set, a choice among what is left.
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
from hypogoal.domains.montezuma_emulator import N_ACTIONS, Emulator, Position
from hypogoal.domains.montezuma_ladders import LADDERS
from hypogoal.domains.montezuma_states import emulator_of_process, gather, labels_of

WANTED_RATE = 700  # on an idle core, where the ceiling was 2,700
ROOMS = (1, 6, 9, 12, 18, 22)  # three ladders; one; one and snakes; lasers; lava; lava and one
RESTORE_EVERY = 40


class Timing(NamedTuple):
    """One room in one repeat: the emulator's agent steps/s beside it, kept states/s, both of CPU time; positives."""

    ceiling: float
    rate: float
    positives: int


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
    found = gather(room, states, seed, ("benchmark",), play="expert", held_out=False, runs_on=False)
    seconds = time.process_time() - begin
    after = time_ceiling(emulator_of_process(), LADDERS[0].top, actions)
    return Timing(statistics.mean((before, after)), states / seconds, int(labels_of(found.ram).sum()))


def summary(name: str, timings: list[Timing]) -> dict[str, Any]:
    """Medians over the timings, and the lowest and highest rate."""
    rates = [timing.rate for timing in timings]
    return {
        "name": name,
        "ceiling_steps_per_second": statistics.median(timing.ceiling for timing in timings),
        "states_per_second": statistics.median(rates),
        "lowest": min(rates),
        "highest": max(rates),
        "ratio": statistics.median(timing.rate / timing.ceiling for timing in timings),
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
    print(f"{states} distinct labelled states uint8 (84, 84, 4) of a room, CPU time of one process, {repeats} repeats")
    print(f"{'':12}{'ceiling, steps/s':>18}{'states/s':>10}{'lowest':>8}{'highest':>9}{'ratio':>8}{'positives':>11}")
    for row in results:
        print(
            f"{row['name']:12}{row['ceiling_steps_per_second']:18,.0f}{row['states_per_second']:10,.0f}"
            f"{row['lowest']:8,.0f}{row['highest']:9,.0f}{row['ratio']:8.2f}{row['positives']:11,.0f}"
        )
    print(f"ratio: states/s to the emulator's agent steps/s, measured before and after; wanted: {WANTED_RATE} states/s")
    if arguments.json:
        record = {"machine": about, "repeats": repeats, "states": states, "results": results}
        arguments.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
