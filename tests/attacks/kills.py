"""Spec G1: every stage killed at random moments and resumed, against the same stage unbroken, byte by byte.

``python -m tests.attacks.kills [--kills 50] [--stages train-meta ...] [--seed 0] [--folder DIR]`` prints a table:
stage, kills, how many of them came while a checkpoint was written, runs that ended, files that differ, losses. A loss
is a resumed stage that fails, or a checkpoint that cannot be read after a kill. With ``--pairs`` nothing is killed: two
processes work on one ``--out`` at once, so many times; how many were refused stands in the second column, and a loss is
a pair of which none made it, or one that was not refused in one line.

A stage runs as a process of its own, forked from this one so that it need not load its libraries again, and gets
SIGKILL. It saves a checkpoint every few milliseconds (``HYPOGOAL_CHECKPOINT_SECONDS``).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hypogoal.core.artefacts import Draft
from hypogoal.core.checkpoints import PACE, Checkpoints

PACES = ("0", "0.02", "0.2")  # seconds between two checkpoints; 0: at every step
GOALS = "sub_goals=open-red-door,go-to-goal"
WHILE_WRITING = 0.4  # share of the kills that wait until a checkpoint is being written
QUICK = ("warm_up=100", "max_episode_steps=60", "random_episodes=5")
DOORKEY = ("heldout_layouts=1", "unlabelled_seeds=1")
ROOMS = ("groups=1", "states_per_room=60", "unlabelled_per_room=30", "heldout_per_room=6")
DESCENT = ("start=1L", "warm_up=60", "replay=300", "environments=3")


def _set(*pairs: str) -> tuple[str, ...]:
    return tuple(word for pair in pairs for word in ("--set", pair))


@dataclass(frozen=True)
class Stage:
    """A stage at toy scale: its command but for ``--out``, and which stages' outputs it reads (``{NAME}``)."""

    name: str
    command: tuple[str, ...]
    needs: tuple[str, ...] = ()
    suffix: str = ""

    def arguments(self, folder: Path) -> list[str]:
        """The command with the outputs it needs in ``folder``."""
        outputs = {name: str(folder / f"{name}{STAGES[name].suffix}") for name in self.needs}
        return [word.format(**outputs) for word in self.command]


_ALL = (
    Stage("data", ("collect", "doorkey", *_set(*DOORKEY)), suffix=".h5"),
    Stage("rooms", ("collect", "montezuma", *_set(*ROOMS, "workers=1")), suffix=".h5"),
    Stage("ensemble", ("train-ensemble", "{data}", *_set("steps=12", "workers=1", "members=2", GOALS)), ("data",)),
    Stage(
        "sequential",
        ("train-ensemble", "{data}", *_set("steps=6", "workers=2", "members=2", "schedule=sequential", GOALS)),
        ("data",),
    ),
    Stage("climbers", ("train-ensemble", "{rooms}", *_set("steps=4", "workers=1", "members=2")), ("rooms",)),
    Stage(
        "options",
        ("train-options", "{ensemble}", *_set("steps=1000", "environments=8", "save_visited=50", *QUICK)),
        ("ensemble",),
    ),
    Stage(
        "meta",
        (
            *("train-meta", "{ensemble}", "--options", "{options}"),
            *_set("steps=1000", "decisions=32", "environments=8", *QUICK),
        ),
        ("ensemble", "options"),
    ),
    Stage("descent", ("train-options", "{climbers}", *_set("steps=120", "steps_for=all", *DESCENT)), ("climbers",)),
    Stage(
        "audit",
        (
            *("audit", "{ensemble}", "--domain", "doorkey", "--sub-goal", "open-red-door"),
            *_set("steps=800", "environments=8", *QUICK),
        ),
        ("ensemble",),
    ),
    Stage("ppo", ("train-baseline", "doorkey", *_set("agent=ppo", "steps=2560", *QUICK[1:]))),
    Stage("dqn", ("train-baseline", "doorkey", *_set("agent=dqn", "steps=1600", *QUICK[1:]))),
)
STAGES = {stage.name: stage for stage in _ALL}


@dataclass
class Tally:
    """What became of one stage."""

    kills: int = 0
    writing: int = 0
    ended: int = 0
    differences: int = 0
    losses: int = 0


def begin(arguments: Sequence[str], log: Path, pace: str | None = None) -> int:
    """Run ``hypogoal`` in a process of its own, its words into ``log``; returns the process."""
    process = os.fork()
    if process:
        return process
    code = 70
    try:
        os.setsid()
        os.environ.pop(PACE, None)
        if pace is not None:
            os.environ[PACE] = pace
        words = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(words, 1)
        os.dup2(words, 2)
        sys.argv = ["hypogoal", *arguments]
        from hypogoal.cli import main

        code = main()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(process: int) -> int | None:
    """The exit code of a process, minus the signal that ended it; None while it runs."""
    found, status = os.waitpid(process, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def unbroken(stage: Stage, folder: Path) -> float:
    """Make a stage's output in ``folder``, without a break and without checkpoints; returns the seconds it took."""
    out, took = folder / f"{stage.name}{stage.suffix}", folder / f"{stage.name}.seconds"
    if not took.exists():
        started = time.monotonic()
        log = folder / f"{stage.name}.log"
        process = begin([*stage.arguments(folder), "--out", str(out), "-q"], log, "1e9")
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        if code:
            raise RuntimeError(f"{stage.name} ended with {code}: {log.read_text(encoding='utf-8')}")
        took.write_text(str(time.monotonic() - started), encoding="utf-8")
    return float(took.read_text(encoding="utf-8"))


def broken(stage: Stage, folder: Path, kills: int, seconds: float, rng: random.Random) -> Tally:
    """Make a stage's output again and again, killed ``kills`` times in all; compare each with the unbroken one.

    Args:
        stage: what to run.
        folder: where its unbroken output is, and those of the stages it needs.
        kills: how many, at least; the last run ends by itself.
        seconds: how long it takes unbroken.
        rng: when to kill.
    """
    tally = Tally()
    whole = folder / f"{stage.name}{stage.suffix}"
    while tally.kills < kills:
        out = folder / f"broken-{stage.name}{stage.suffix}"
        log = folder / f"broken-{stage.name}.log"
        patience = rng.choice((0.3, 0.6, 1.0))
        while not out.exists():
            process = begin([*stage.arguments(folder), "--out", str(out), "--resume", "-q"], log, rng.choice(PACES))
            # Less and less hurry, so that a stage that begins slowly gets on: of each time it needs about a third.
            patience *= 1.1
            moment = time.monotonic() + rng.uniform(0, patience * seconds) if tally.kills < kills else float("inf")
            awaited = rng.random() < WHILE_WRITING
            while (code := ended(process)) is None and (
                time.monotonic() < moment or (awaited and not half_written(out))
            ):
                time.sleep(0.0005)
            if code is None:
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)
                tally.kills += 1
                tally.writing += half_written(out)
                tally.losses += unreadable(out)
            elif code:
                tally.losses += 1
                print(log.read_text(encoding="utf-8")[-2000:], file=sys.stderr)
                shutil.rmtree(Draft(out).folder, ignore_errors=True)
                break
        else:
            tally.ended += 1
            differ = differences(whole, out)
            print("".join(f"{stage.name}: {name} differs\n" for name in differ), end="", file=sys.stderr)
            tally.differences += len(differ)
            tally.losses += Draft(out).folder.exists() and not left_over(out)
            _remove(out)
    return tally


def paired(stage: Stage, folder: Path, pairs: int, seconds: float, rng: random.Random) -> Tally:
    """Start a stage twice at once on one output, ``pairs`` times; arguments else as of :func:`broken`."""
    tally = Tally()
    whole, out = (folder / f"{name}{stage.suffix}" for name in (stage.name, f"pair-{stage.name}"))
    logs = [folder / f"pair-{stage.name}-{number}.log" for number in range(2)]
    for _ in range(pairs):
        processes = []
        for log in logs:
            log.write_text("", encoding="utf-8")
            how = rng.choice(([], ["--resume"], ["--force"]))
            processes.append(begin([*stage.arguments(folder), "--out", str(out), "-q", *how], log, rng.choice(PACES)))
            time.sleep(rng.choice((0.0, rng.uniform(0, seconds))))
        codes = [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes]
        words = [log.read_text(encoding="utf-8") for log in logs]
        refused = [text for text, code in zip(words, codes, strict=True) if code]
        fine = sorted(codes) in ([0, 0], [0, 2]) and all(text.count("\n") == 1 for text in refused)
        differ = differences(whole, out) if out.exists() else [str(out)]
        if not fine or differ:
            print(f"{stage.name}: {codes} {words} {differ}", file=sys.stderr)
        tally.kills += 1
        tally.writing += len(refused)
        tally.ended += codes.count(0)
        tally.differences += len(differ)
        tally.losses += not fine or Draft(out).folder.exists()
        _remove(out)
    return tally


def half_written(out: Path) -> bool:
    """Whether a checkpoint is being written, or was when its process was killed."""
    return any(Draft(out).checkpoint.glob("*.new"))


def unreadable(out: Path) -> int:
    """How many of the checkpoints beside an output cannot be read."""
    from hypogoal.core.errors import UserError

    count = 0
    for path in Draft(out).checkpoint.glob("*.safetensors"):
        try:
            Checkpoints(path).load()
        except UserError:
            count += 1
    return count


def left_over(out: Path) -> bool:
    """Whether a draft is what a process leaves that dies after its output is whole."""
    return not (Draft(out).folder / "files" / "manifest.json").exists()


def differences(one: Path, other: Path) -> list[str]:
    """Files of two outputs that are not the same bytes; a manifest's command line, which says --out, is left out."""
    if one.is_file():
        return [] if one.read_bytes() == other.read_bytes() else [one.name]
    names = {path.relative_to(folder).as_posix() for folder in (one, other) for path in folder.rglob("*")}
    return [name for name in sorted(names) if not _same(one / name, other / name)]


def _same(one: Path, other: Path) -> bool:
    if one.is_dir() or not (one.exists() and other.exists()):
        return one.is_dir() and other.is_dir()
    if one.name == "manifest.json":
        one_text, other_text = (json.loads(path.read_text(encoding="utf-8")) for path in (one, other))
        told = {"command": None, "took": None, "sha256": None}  # the last is of the whole text
        return {**one_text, **told} == {**other_text, **told}
    return one.read_bytes() == other.read_bytes()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def needed(names: Sequence[str]) -> list[str]:
    """Stages by name and those whose outputs they read, in an order in which they can run."""
    wanted: set[str] = set()
    todo = list(names)
    while todo:
        name = todo.pop()
        wanted.add(name)
        todo += STAGES[name].needs
    return [name for name in STAGES if name in wanted]


def main() -> int:
    """The long version."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each stage")
    parser.add_argument("--pairs", type=int, default=0, help="of each stage, instead of kills")
    parser.add_argument("--stages", nargs="*", choices=[*STAGES], default=[*STAGES])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one where not given")
    given = parser.parse_args()
    import torch
    import torch._dynamo  # which every process would load with its first optimiser

    import hypogoal.learners.baselines.agents
    import hypogoal.meta.training  # noqa: F401

    torch.set_num_threads(1)
    folder = given.folder or Path(tempfile.mkdtemp(prefix="kills-"))
    folder.mkdir(parents=True, exist_ok=True)
    columns = ("pairs", "refused") if given.pairs else ("kills", "writing")
    print(f"{'stage':12s} {columns[0]:>6s} {columns[1]:>8s} {'ended':>6s} {'differences':>12s} {'losses':>7s}")
    attack, count = (paired, given.pairs) if given.pairs else (broken, given.kills)
    bad = 0
    for name in needed(given.stages):
        seconds = unbroken(STAGES[name], folder)
        if name not in given.stages:
            continue
        t = attack(STAGES[name], folder, count, seconds, random.Random(f"{given.seed} {name}"))
        print(f"{name:12s} {t.kills:6d} {t.writing:8d} {t.ended:6d} {t.differences:12d} {t.losses:7d}", flush=True)
        bad += t.differences + t.losses
    if given.folder is None and not bad:
        shutil.rmtree(folder)
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
