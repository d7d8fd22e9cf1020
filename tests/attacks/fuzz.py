"""Spec G2: thousands of damaged and hostile files of each format, read by every command that reads them.

``python -m tests.attacks.fuzz --cases 5000`` prints a table. A case fails when a command ends other than with success
or with one line and exit code 2, takes longer than ``SECONDS``, needs more than ``MEMORY`` beyond what it began with,
or changes a file outside its output. ``--format hdf5 --case 17 --debug`` runs one case again with its traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import io
import json
import os
import random
import resource
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hypogoal.core.artefacts import create_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.core.manifests import sealed
from hypogoal.data import Collected, States, write_dataset
from tests.attacks.mutations import (
    ENDLESS,
    Rng,
    bytes_changed,
    hdf5_changed,
    json_changed,
    odd_values,
    safetensors_changed,
    toml_of,
    tree_changed,
)

SECONDS = 60.0  # of the clock: the machine may be busy
MEMORY = 2**30
SUB_GOALS, MEMBERS, SHAPE, NETWORK = ("open-red-door", "go-to-goal"), 2, (24, 32, 3), "tiles"  # small
PRESET = {
    "collect": {"door_label": "open", "unlabelled_seeds": [1, 2], "heldout_layouts": 20},
    "train-ensemble": {"members": 3, "sub_goals": ["go-to-goal"], "diversity_weight": 1e-4, "network": "doorkey"},
    "train-options": {"steps": 100, "chooser": "random", "bootstrap_timeout": True},
    "train-meta": {"clip": 0.2, "decisions": 64, "termination": "learned"},
    "train-baseline": {"agent": "ppo", "setting": "tuned"},
    "run": {"layout_seeds": [100, 101], "seeds": [0], "controls": ["random"]},
}
PLANNED = (0, -1, 10**400, 1e308, True, ["evaluate", "/"], ["report", "/"], ["evaluate", "{run}/.."], ["report"],
           ["collect", "x", "--out", "/x"], ["collect", "{run}/../x"], ["/"], {"seed": 10**400})  # fmt: skip
OWN = """
format = 1
evaluate = true
workers = 2
axes = { seed = [0, 1], layout = "210-211" }
cells = [
  { name = "data", command = "collect doorkey --set heldout_layouts=1" },
  { name = "ensemble", axes = ["seed"], command = "train-ensemble {data} --seed {seed}" },
  { name = "ppo", axes = ["seed", "layout"], command = "train-baseline doorkey --layout-seed {layout}" },
]
"""


def make_seeds(root: Path) -> None:
    """A small run, whole: data, ensemble, options, meta, with made-up numbers in the real formats."""
    import torch

    from hypogoal.core.files import write_table
    from hypogoal.core.seeding import torch_generator
    from hypogoal.core.tensors import save_tensors
    from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble
    from hypogoal.options.networks import LightQNetwork
    from hypogoal.options.tables import Choices, Episodes, Executions

    rng = np.random.default_rng(0)

    def states(count: int) -> States:
        images = rng.integers(0, 4, size=(count, *SHAPE), dtype=np.uint8)
        return States(images, np.arange(2 * count).reshape(count, 2) % 3 == 0, {"layout_seed": np.arange(count)})

    collected = Collected(SHAPE, SUB_GOALS, states(6), states(5), states(4))
    write_dataset(root / "data.h5", collected, domain="doorkey", config={"a": [1, 2]}, seed=3)
    about = {"sub_goals": list(SUB_GOALS), "members": MEMBERS, "network": NETWORK, "observation_shape": list(SHAPE)}
    about |= {"domain": "doorkey", "domain_config": {"wrong_key": "harmless"}, "diversity": "dbat", "view": "full"}
    about["observation_dtype"] = "uint8"
    with create_artefact(root / "ensemble", kind="ensemble", config=about, seed=0, inputs=[root / "data.h5"]) as folder:
        for sub_goal in SUB_GOALS:
            write_ensemble(folder, sub_goal, Ensemble(NETWORK, SHAPE, MEMBERS, torch_generator(0, sub_goal)))
        (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 0.5}\n' * 3)
    options = len(SUB_GOALS) * MEMBERS
    settings = about | {"network": "light", "termination": "learned", "chooser": "ppo", "layout_seed": 100, "steps": 50}
    settings |= {"option_timeout": 10, "mask_reached": True, "setting": "light", "max_episode_steps": 60}
    settings |= {"embedding": "auto", "layouts": ""}
    for kind, inputs in (("options", ["ensemble"]), ("meta", ["ensemble", "options"])):
        with create_artefact(
            root / kind, kind=kind, config=settings, seed=0, inputs=[root / name for name in inputs]
        ) as folder:
            state = {f"online.{name}": value for name, value in LightQNetwork(SHAPE, options, 7).state_dict().items()}
            counters = {
                name: torch.zeros(options, dtype=torch.int64) for name in ("option_steps", "steps_since_positive")
            }
            save_tensors(folder / "options.safetensors", state | counters)
            write_table(
                folder / "episodes.csv", Episodes.names(), [(10 * n, 10, 1.0, n % 2, n % 2) for n in range(1, 6)]
            )
            write_table(folder / "choices.csv", Choices.names(), [(50, n, 9, 3, 2.5, 1, 8) for n in range(options)])
            rows = [(n, n % options, 3, 1, 0, 0, 1, 10, 20, 5) for n in range(6)]
            write_table(folder / "executions.csv", Executions.names(), rows)
            facts = {"layout_seed": 100, "shortest_path": 9, "random_success": 0.1, "random_episodes": 5}
            (folder / "layout.json").write_text(json.dumps(facts))
            (folder / "metrics.jsonl").write_text('{"step": 1, "success": 0.5}\n')
            if kind == "meta":
                save_tensors(folder / "meta.safetensors", {"none": torch.zeros(1)})
            with h5py.File(folder / "terminations.h5", "w") as file:
                file.create_dataset("0", data=collected.unlabelled.observations, compression="gzip")
    (root / "secret").write_text("secret")


class Sandbox:
    """Where cases run: ``seeds`` whole, ``case`` damaged, ``out`` the output; everything else must stay as it is."""

    def __init__(self, root: Path):
        self.root, self.seeds, self.case, self.out = root, root / "seeds", root / "case", root / "out"
        self.outside = root / "outside"
        for folder in (self.seeds, self.outside):
            folder.mkdir(parents=True)
        make_seeds(self.seeds)
        self.odd = odd_values(self.outside)
        os.chdir(self.outside)
        self.before = self.look()

    def look(self) -> dict[str, tuple[int, int]]:
        """Everything that no case may change: path, size and time of the last change."""
        ours = (path for part in (self.seeds, self.outside) for path in part.rglob("*"))
        return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in ours}

    def fresh(self) -> None:
        """An empty ``out``, and in ``case`` the whole run again."""
        for folder in (self.case, self.out):
            shutil.rmtree(folder, ignore_errors=True)
        self.out.mkdir()
        shutil.copytree(self.seeds, self.case)


def command(*arguments: object) -> None:
    """Run a command that must succeed or refuse; raises ``UserError`` where it refuses."""
    from hypogoal.cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        code = main([str(argument) for argument in arguments] + (["--debug"] if DEBUG else []))
    text = said.getvalue().strip()
    if code == 2:
        raise UserError(text)
    if code != 0:
        raise AssertionError(f"{arguments[0]} ended with {code}: {text[-300:]}")


def tolerated(*calls: Callable[[], object]) -> bool:
    """Whether all calls succeeded; one that refuses (``UserError``) is no failure."""
    accepted = True
    for call in calls:
        try:
            call()
        except UserError as error:
            accepted = False
            if "\n" in str(error) or not str(error).isprintable():
                raise AssertionError(f"not one printable line: {str(error)!r}") from None
    return accepted


def resigned(artefact: Path, name: str) -> None:
    """Make the manifest agree with a changed file: damage that no hash betrays."""
    path = artefact / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["files"][name] = sha256_of(artefact / name)
    path.write_bytes(sealed(manifest))


def read_run(case: Path, kind: str, often: bool) -> list[Callable[[], object]]:
    """The ways in which another stage or a program reads an artefact of a run; commands, which take long, at times."""
    import hypogoal
    from hypogoal.evaluation import curves
    from hypogoal.evaluation.run import find
    from hypogoal.inspection import describe_path, faults_of, lines

    path = case / kind

    def inputs() -> None:
        found = find(case)
        for artefact in found.everything():
            for entry in artefact.manifest["inputs"]:
                artefact.input(entry["kind"])
        for artefact in found.agents:
            list(curves.rows_of_run(curves.read_run(artefact, "agent"), "agent"))

    def check() -> None:
        faults = faults_of(path)
        if faults:
            raise UserError(faults[0])

    use = (
        partial(hypogoal.load_ensemble, path, "go-to-goal")
        if kind == "ensemble"
        else partial(hypogoal.load_options, path)
    )
    calls: list[Callable[[], object]] = [check, lambda: lines(describe_path(path)), use, inputs]
    if often:
        calls += [lambda: command("verify", path, "--json"), lambda: command("show", path)]
    return calls


def read_table(path: Path) -> None:
    """A table or file of the artefact ``meta``, as its readers do."""
    from hypogoal.evaluation import run
    from hypogoal.options.tables import Choices, Episodes, Executions

    readers: dict[str, Callable[[Path], Any]] = {
        "episodes.csv": Episodes.read,
        "choices.csv": lambda path: Choices.read(path).total("chosen", 4),
        "executions.csv": Executions.read,
        "layout.json": run.read_layout,
        "terminations.h5": run.read_terminations,
    }
    readers[path.name](path)


def trained(box: Sandbox, stage: str, source: Path, *more: str) -> Callable[[], object]:
    """A stage that starts from a damaged file and must write into ``out`` only."""
    few = ("--set", "steps=8", "--quiet")
    return lambda: command(stage, source, "--out", box.out / "made", *few, *more)


def fuzz_manifest(box: Sandbox, rng: Rng, case: int) -> bool:
    kind = rng.choice(("ensemble", "meta", "options"))
    path = box.case / kind / "manifest.json"
    path.write_bytes(json_changed(path.read_bytes(), rng, box.odd))
    if rng.random() < 0.2:
        manifest, place = json.loads((box.seeds / kind / path.name).read_bytes()), rng.choice(ENDLESS)
        for entry in manifest["inputs"]:
            entry |= {"path": place, rng.choice(("relative", "kind")): rng.choice((place, "data"))}
        path.write_bytes(json.dumps(manifest).encode())
    if rng.random() < 0.9:  # by somebody who seals it: the checksum betrays nothing
        with contextlib.suppress(ValueError, AttributeError, RecursionError):
            path.write_bytes(sealed(json.loads(path.read_bytes())))
    if rng.random() < 0.1:
        name = path.parent / rng.choice(sorted(os.listdir(path.parent)))
        name.unlink()
        os.symlink(rng.choice((box.seeds / "secret", "/dev/zero", "..", name)), name)
    calls = read_run(box.case, kind, case % 10 == 0)
    if case % 100 == 0:
        own = ("--set", "environments=2", "--set", "warm_up=4", "--set", "random_episodes=0")
        calls.append(trained(box, "train-options", box.case / "ensemble", *own))
    return tolerated(*calls)


def fuzz_hdf5(box: Sandbox, rng: Rng, case: int) -> bool:
    from hypogoal.inspection import describe_path, faults_of, lines

    path = box.case / "data.h5"
    if rng.random() < 0.5:
        path.write_bytes(bytes_changed(path.read_bytes(), rng))
    else:
        with contextlib.suppress(OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError):
            hdf5_changed(path, rng, box.odd, box.seeds / "secret")

    def check() -> None:
        faults = faults_of(path)
        if faults:
            raise UserError(faults[0])

    calls: list[Callable[[], object]] = [check, lambda: lines(describe_path(path))]
    if case % 10 == 0:
        calls += [lambda: command("verify", path, "--json"), lambda: command("show", path)]
    if case % 100 == 0:
        calls.append(trained(box, "train-ensemble", path, "--set", "workers=1"))
    return tolerated(*calls)


def fuzz_safetensors(box: Sandbox, rng: Rng, case: int) -> bool:
    where, name = rng.choice((("ensemble", "go-to-goal.safetensors"), ("meta", "options.safetensors")))
    path = box.case / where / name
    path.write_bytes(safetensors_changed(path.read_bytes(), rng, box.odd))
    if rng.random() < 0.9:
        resigned(path.parent, name)
    return tolerated(*read_run(box.case, where, case % 10 == 0))


def fuzz_tables(box: Sandbox, rng: Rng, case: int) -> bool:
    name = rng.choice(("episodes.csv", "choices.csv", "executions.csv", "layout.json", "terminations.h5"))
    path = box.case / "meta" / name
    if name.endswith(".json"):
        path.write_bytes(json_changed(path.read_bytes(), rng, box.odd))
    else:
        path.write_bytes(bytes_changed(path.read_bytes(), rng))
    resigned(path.parent, name)
    calls = read_run(box.case, "meta", often=False) if case % 10 == 0 else []
    return tolerated(lambda: read_table(path), *calls)


def fuzz_toml(box: Sandbox, rng: Rng, case: int) -> bool:
    from hypogoal.core.config import resolve
    from hypogoal.experiments.named import EXPERIMENTS
    from hypogoal.settings import STAGES, TABLES
    from hypogoal.stages.sweep import config_class_of, plan

    path = box.case / "own.toml"
    text = toml_of(tree_changed(PRESET, rng, box.odd), rng).encode(errors="surrogatepass")
    if case % 100 == 1:
        text = b"a = " + b"[" * 100_000
    path.write_bytes(bytes_changed(text, rng) if rng.random() < 0.3 else text)
    stages: list[Callable[[], object]] = [
        partial(resolve, config_class_of(stage), stage=stage, preset=str(path), tables=TABLES) for stage in STAGES
    ]
    runs: list[Callable[[], object]]
    if case % 10:
        runs = [partial(plan, name, box.out / "run", preset=str(path)) for name in EXPERIMENTS]
    else:
        runs = [
            partial(command, "run", name, "--out", box.out / "run", "--preset", path, "--dry-run")
            for name in EXPERIMENTS
        ]
    return tolerated(*stages, *runs)


def fuzz_sweep(box: Sandbox, rng: Rng, case: int) -> bool:
    """An own experiment; the plan, records and last words that a sweep leaves, and the log of what a cell made."""
    from hypogoal.experiments.planning import make_plan
    from hypogoal.experiments.records import PLAN, write_plan
    from hypogoal.experiments.status import lines as lines_of
    from hypogoal.experiments.status import read_status
    from hypogoal.experiments.toml_file import read_toml

    own, run = box.case / "own.toml", box.out / "run"
    own.write_text(OWN, encoding="utf-8")
    if rng.random() < 0.3:
        text = toml_of(tree_changed(tomllib.loads(OWN), rng, box.odd), rng).encode(errors="surrogatepass")
        own.write_bytes(bytes_changed(text, rng) if rng.random() < 0.3 else text)
        return tolerated(lambda: make_plan(read_toml(own), run, ["seed=0-2"] if case % 2 else []))
    planned = make_plan(read_toml(own), run)
    write_plan(run, planned)
    (run / "logs").mkdir(exist_ok=True)
    said = str(rng.choice(box.odd))[:9999]
    (run / "logs" / "data.log").write_text(f"started\n{said}", encoding="utf-8", errors="replace")
    record = json.dumps({"attempts": 1, "seconds": 2.0, "code": 2, "started": 0.0, "host": "here"}).encode()
    (run / "logs" / "data.json").write_bytes(json_changed(record, rng, box.odd))
    plan, kind = (run / PLAN).read_bytes(), rng.random()
    if kind < 0.4:  # one value, which every reader meets
        tree = json.loads(plan)
        holder = rng.choice((tree, *tree["cells"]))
        holder[rng.choice([*holder])] = rng.choice((*PLANNED, *box.odd))
        (run / PLAN).write_text(json.dumps(tree), encoding="utf-8")
    elif kind < 0.8:
        (run / PLAN).write_bytes(json_changed(plan, rng, box.odd))
    made = run / "ensemble" / "seed-0"
    for cell in planned.cells if rng.random() < 0.5 else planned.cells[:2]:  # all that is evaluated, or not yet
        copy = shutil.copyfile if cell.out.suffix else shutil.copytree
        cell.out.parent.mkdir(exist_ok=True)
        copy(box.seeds / ("data.h5" if cell.out.suffix else "ensemble"), cell.out)
    lines = [json_changed(b'{"step": 1, "sub_goal": "go-to-goal", "loss": 0.5}', rng, box.odd) for _ in range(3)]
    (made / "metrics.jsonl").write_bytes(b"\n".join(lines))
    resigned(made, "metrics.jsonl")
    commands = [("sweep", "--out", run, *words) for words in (("--status",), ("--status", "--json"), ("--gather",))]
    with (run / "logs" / "data.log").open("ab") as log:
        if rng.random() < 0.5:  # as one who runs the cell would
            fcntl.flock(log, fcntl.LOCK_EX)
        calls = [partial(command, *words) for words in commands]
        return tolerated(lambda: lines_of(read_status(run)), *calls)


def fuzz_observations(box: Sandbox, rng: Rng, case: int) -> bool:
    """What people import: an observation of any shape and type, a turned picture, labels that contradict each other."""
    from tests.attacks.observations import check_labels, check_upright, drawn_observation, outcome_of

    check_upright(box.out, rng)
    outcomes = check_labels(rng), outcome_of(*drawn_observation(rng)) != "refused"
    return all(outcomes)


FORMATS: dict[str, Callable[[Sandbox, Rng, int], bool]] = {
    "manifest": fuzz_manifest,
    "hdf5": fuzz_hdf5,
    "safetensors": fuzz_safetensors,
    "tables": fuzz_tables,
    "toml": fuzz_toml,
    "sweep": fuzz_sweep,
    "observations": fuzz_observations,
}
DEBUG = False


def work(name: str, cases: range, seed: int) -> Iterator[dict[str, Any]]:
    """Run cases in this process, in a sandbox of its own; yields how each ended."""
    import torch

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        box = Sandbox(Path(folder))
        box.fresh()
        for kind in ("ensemble", "meta"):  # everything is loaded now, and whole files are accepted
            if not tolerated(*read_run(box.case, kind, often=True), lambda: command("verify", box.case / "data.h5")):
                raise AssertionError(f"the whole {kind} was refused")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))
        for case in cases:
            yield {"case": case, "begins": True}
            rng = random.Random(f"{seed} {name} {case}")
            box.fresh()
            begun = time.monotonic()
            try:
                outcome, why = ("accepted" if FORMATS[name](box, rng, case) else "refused"), ""
            except Exception as error:  # that nothing else escapes is what is tested
                if DEBUG:
                    raise
                outcome, why = "crashed", f"{type(error).__name__}: {error}"
            if box.look() != box.before:
                outcome, why = "escaped", "a file outside the output was changed"
                box.before = box.look()
            yield {"case": case, "outcome": outcome, "why": why, "seconds": time.monotonic() - begun}
        os.chdir("/")


def fuzz(name: str, cases: int, seed: int) -> dict[str, Any]:
    """All cases of a format, in child processes that are started again when one dies or hangs."""
    counts: Counter[str] = Counter()
    failures: list[str] = []
    slowest, following = 0.0, 0
    while following < cases:
        arguments = ["--format", name, "--seed", str(seed), "--worker", str(following), str(cases)]
        with subprocess.Popen(
            [sys.executable, "-m", "tests.attacks.fuzz", *arguments], stdout=subprocess.PIPE
        ) as child:
            lines = _lines(child)
            for row in lines:
                if "begins" in row:
                    following = row["case"] + 1
                    continue
                counts[row["outcome"]] += 1
                slowest = max(slowest, row["seconds"])
                if row["outcome"] not in ("accepted", "refused"):
                    failures.append(f"{name} case {row['case']}: {row['outcome']}: {row['why']}")
            code = child.wait()
        if code:
            ended = "hung" if code == -9 else "died"
            counts[ended] += 1
            failures.append(f"{name} case {following - 1}: {ended} (exit code {code})")
            if following == 0:
                raise RuntimeError("the fuzzer itself fails, see above")
    bad = {kind: counts[kind] for kind in ("crashed", "hung", "died", "escaped")}
    return {"format": name, "cases": cases, "accepted": counts["accepted"], "refused": counts["refused"], **bad,
            "slowest": round(slowest, 2), "failures": failures}  # fmt: skip


def _lines(child: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    """What a worker says, until it ends, or is killed because it says nothing for long."""
    assert child.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(child.stdout, selectors.EVENT_READ)
        patience = 600.0  # to start
        while selector.select(patience):
            line = child.stdout.readline()
            if not line:
                return
            yield json.loads(line)
            patience = SECONDS
    child.kill()


def main() -> int:
    """Run the fuzz; exit code 1 when a case failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", action="append", choices=FORMATS)
    parser.add_argument("--case", type=int)
    parser.add_argument("--debug", action="store_true")
    parser.add_argument("--worker", type=int, nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker or given.case is not None:
        global DEBUG
        DEBUG = given.debug
        cases = range(*given.worker) if given.worker else range(given.case, given.case + 1)
        for row in work(given.format[0], cases, given.seed):
            os.write(1, (json.dumps(row) + "\n").encode())
        return 0
    rows = []
    print("| format | cases | accepted | refused | crashed | hung | died | escaped | slowest |\n" + "|---" * 9 + "|")
    for name in given.format or FORMATS:
        row = fuzz(name, given.cases, given.seed)
        rows.append(row)
        print(f"| {' | '.join(str(value) for key, value in row.items() if key != 'failures')} s |", flush=True)
    failures = [failure for row in rows for failure in row["failures"]]
    print("\n".join(failures[:50]), file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
