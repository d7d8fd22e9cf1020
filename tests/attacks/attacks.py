"""Spec G1, G2: full disks, signals and turned clocks while stages run; files made to hurt whoever reads them.

``python -m tests.attacks.attacks [--family disk ...] [--cases 20] [--seed 0] [--json FILE]`` prints a row for each
family. A case is bad when a command ends in a traceback, in more than one line, or not at all; when it writes outside
its output or takes more memory than a small file is worth; when an output is there and not whole, has other bytes after
``--resume`` than an undisturbed one, or when a process outlives its stage. ``--case 7`` runs one case again.

``disk`` mounts a tmpfs, so it needs root on Linux; ``clock`` and ``writes`` need a C compiler. Without them these are
left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.checkpoints import FOLDER, PACE, Checkpoints
from hypogoal.core.drafts import draft_folder
from hypogoal.core.workers import PYTHON
from tests.attacks import hostile
from tests.attacks.hostile import TRAINED
from tests.attacks.kills import PACES, STAGES, Stage, differences, needed, unbroken
from tests.attacks.mutations import state_changed
from tests.attacks.sweeps import TOY

SECONDS, WAIT = 60.0, 300.0  # of a core that a command may take; of the clock, on whatever machine
MEMORY, SMALL = 2**30, 16 * 2**20  # bytes that a file below SMALL may cost
PATIENCE = 10.0  # seconds for processes to die with their stage
EVALUATION = Stage("evaluation", ("evaluate", "{run}"))
REPORT = Stage("report", ("report", "{out}"))
COMPILER = shutil.which("cc")
Rng = random.Random


class Bad(Exception):
    """What an attack came to that it must not."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code, minus the signal; stderr, of ``verify`` stdout too; seconds; bytes of memory."""

    command: str
    code: int
    words: str
    seconds: float
    memory: int

    def accepted(self, *codes: int) -> bool:
        """Whether it succeeded; anything but that, one line and exit code 2, or one of ``codes``, is bad."""
        lines = self.words.splitlines()
        if self.code < 0 and self.code in codes and not lines:
            return False
        if self.code not in (0, 2, *codes):
            raise Bad(f"ended with {self.code}: {self.words[-400:]}")
        if "Traceback" in self.words or "internal error" in self.words or "Exception ignored" in self.words:
            raise Bad(f"a traceback: {self.words[-400:]}")
        told = self.command == "verify" or (len(lines) == 1 and lines[0].startswith("hypogoal: "))
        if self.code and not (told and lines and "".join(lines).isprintable()):
            raise Bad(f"not one line, {self.code}: {self.words[-400:]}")
        return self.code == 0


class Command:
    """``hypogoal`` in a process of its own, the first of its group: forked from this one, or begun ``anew``."""

    def __init__(
        self,
        *arguments: object,
        anew: bool = False,
        environment: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ):
        words, environment = [str(argument) for argument in arguments], {**os.environ, **(environment or {})}
        self.arguments, self.began = words, time.monotonic()
        self.said, self.log = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - as long as this is
        if anew:
            command = [*PYTHON, "-m", "hypogoal", *words]
            self.process = subprocess.Popen(
                command, stdout=self.said, stderr=self.log, env=environment, cwd=folder, process_group=0
            ).pid
        else:
            self.process = os.fork() or self._run(words, environment)

    def _run(self, words: list[str], environment: Mapping[str, str]) -> int:
        code = 70
        try:
            os.setpgid(0, 0)
            os.dup2(self.said.fileno(), 1)
            os.dup2(self.log.fileno(), 2)
            os.environ.update(environment)
            sys.argv = ["hypogoal", *words]
            from hypogoal.cli import main

            code = main()
            sys.stdout.flush()
        except BaseException:  # noqa: BLE001 - that nothing escapes is what is tested
            traceback.print_exc()
        finally:
            os._exit(code)

    def output(self, file: Any = None) -> str:
        """What it wrote to stdout, or to another file."""
        file = file or self.said
        file.seek(0)
        return str(file.read().decode(errors="replace"))

    def send(self, number: int, group: bool = False) -> None:
        """Send a signal to the process, or to its whole group as a terminal does."""
        with suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(self.process, number)

    def running(self) -> bool:
        """Whether it has not ended yet, nor been waited for."""
        return os.waitid(os.P_PID, self.process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def wait(self, seconds: float = SECONDS) -> Ended:
        """Wait until it ends; whoever hangs, or leaves processes behind, is killed and bad."""
        hangs = False
        while not hangs and self.running():
            time.sleep(0.002)
            hangs = time.monotonic() - self.began > WAIT or worked(self.process) > seconds
        if hangs:
            self.send(signal.SIGKILL, group=True)
        _, status, usage = os.wait4(self.process, 0)
        took = time.monotonic() - self.began
        if hangs:
            raise Bad(f"hung: {' '.join(self.arguments)}")
        until = time.monotonic() + PATIENCE
        while orphans := group_of(self.process):
            if time.monotonic() > until:
                os.killpg(self.process, signal.SIGKILL)
                raise Bad(f"left processes behind: {orphans}")
            time.sleep(0.01)
        words = self.output(self.log) + (self.output() if self.arguments[0] == "verify" else "")
        return Ended(
            self.arguments[0], os.waitstatus_to_exitcode(status), words, took, usage.ru_maxrss * 1024 - BASELINE
        )


BASELINE = 0


def worked(process: int) -> float:
    """Seconds of a core that a process has had."""
    ticks = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def group_of(leader: int) -> list[int]:
    """The processes of a group that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _parent, group = path.read_text().rpartition(")")[2].split()[:3]
            if int(group) == leader and state != "Z":
                found.append(int(path.parent.name))
    return found


def run(*arguments: object, pace: str = "1e9") -> Ended:
    """A command from its beginning to its end, with a checkpoint every ``pace`` seconds."""
    return Command(*arguments, environment={PACE: pace}).wait()


class Box:
    """Where cases run: ``run`` is whole, ``whole`` has undisturbed outputs, ``case`` is each case's own."""

    def __init__(self, root: Path):
        self.root, self.run, self.whole, self.case = root, root / "run", root / "whole", root / "case"
        self.outside = root / "outside"
        self.seconds: dict[str, float] = {}
        self.most = 0  # bytes that a command took to read a file
        shutil.rmtree(self.whole, ignore_errors=True)
        for folder in (self.run, self.whole, self.outside):
            folder.mkdir(parents=True, exist_ok=True)
        (self.outside / "secret").write_text("secret")
        os.chdir(self.outside)
        self.look = self._look()

    def ready(self, *names: str, evaluated: bool = False) -> Path:
        """The run, with the outputs of stages, and its evaluation and report."""
        for name in needed(names):
            unbroken(STAGES[name], self.run)
        missing = evaluated and not (self.run / "report").exists()
        for command in (("evaluate", self.run), ("report", self.run)) if missing else ():
            if not run(*command, "-q", "--resume").accepted():
                raise RuntimeError("the run cannot be evaluated")
        self.look = self._look()
        return self.run

    def _look(self) -> dict[str, tuple[int, int]]:
        ours = (path for part in (self.run, self.outside) for path in part.rglob("*"))
        return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in ours}

    def fresh(self) -> Path:
        """An empty folder for a case."""
        shutil.rmtree(self.case, ignore_errors=True)
        self.case.mkdir()
        return self.case

    def check_outside(self) -> None:
        """Nothing that is not a case's own may have changed."""
        if self._look() != self.look:
            changed = {*self._look().items()} ^ {*self.look.items()}
            self.look = self._look()
            raise Bad(f"wrote outside its output: {sorted(changed)[:3]}")

    def command(self, stage: Stage, folder: Path) -> tuple[list[str], Path]:
        """A stage's command and output, in ``folder`` beside the run: relative paths in manifests are the same."""
        run = self.ready(*(TRAINED if stage in (EVALUATION, REPORT) else stage.needs), evaluated=stage is REPORT)
        if stage is REPORT:  # which is of the folder that it lies in, whose name is on the page
            folder /= "run"
            if not folder.exists():
                shutil.copytree(run / "evaluation", folder / "evaluation")
            return ["report", str(folder), "-q"], folder / "report"
        out = folder / f"{stage.name}{stage.suffix}"
        words = [word.replace("{run}", str(run)) for word in stage.command]
        inputs = {name: str(run / f"{name}{STAGES[name].suffix}") for name in stage.needs}
        return [*(word.format(**inputs) for word in words), "--out", str(out), "-q"], out

    def undisturbed(self, stage: Stage) -> tuple[Path, float]:
        """The output of a stage that nothing befell, and the seconds it took."""
        words, out = self.command(stage, self.whole)
        if stage.name not in self.seconds:
            ended = run(*words)
            if not ended.accepted():
                raise RuntimeError(ended.words)
            self.seconds[stage.name] = ended.seconds
        return out, self.seconds[stage.name]


def pick(case: int) -> Stage:
    """The stages in turn."""
    stages = [*(STAGES[name] for name in TRAINED), EVALUATION, REPORT]
    return stages[case % len(stages)]


def unlike(stage: Stage, whole: Path, out: Path) -> list[str]:
    """The files that are not the same bytes; a report's manifest says where its folder is."""
    return [name for name in differences(whole, out) if stage is not REPORT or name != "manifest.json"]


def check_whole(out: Path) -> None:
    """An output that is there is whole."""
    if out.exists() and not (ended := run("verify", out)).accepted():
        raise Bad(f"half an output: {ended.words}")


def check_resumed(box: Box, stage: Stage, words: list[str], out: Path) -> None:
    """A stage gone on with to its end gives the bytes of one that nothing befell."""
    check_whole(out)
    ended = run(*words, "--resume")
    if not ended.accepted():
        raise Bad(f"cannot be gone on with: {ended.words}")
    differ = unlike(stage, box.undisturbed(stage)[0], out)
    left = [path.name for path in out.parent.iterdir() if path.name.startswith(".")]
    if differ or left:
        raise Bad(f"{stage.name}: {differ} differ, {left} are left")


@contextmanager
def disk_of(folder: Path) -> Iterator[Callable[[int | None], None]]:
    """A disk at ``folder``; yields what leaves so many bytes free of it, or as many as one likes."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "tmpfs", str(folder), "-o"]
    subprocess.run([*mount, "size=8g"], check=True)

    def leave(free: int | None) -> None:
        used = shutil.disk_usage(folder).used
        size = "8g" if free is None else str(max(4096, used + free))
        subprocess.run([*mount[:1], *mount[-1:], f"remount,size={size}", str(folder)], check=True)

    try:
        yield leave
    finally:
        subprocess.run(["umount", "-l", folder], check=True)
        folder.rmdir()


def disk(box: Box, rng: Rng, case: int) -> bool:
    """A disk that fills while a stage runs; room is made, and the stage gone on with."""
    stage = pick(case)
    _whole, seconds = box.undisturbed(stage)
    folder = box.root / f"disk{case}"
    with disk_of(folder) as leave:
        words, out = box.command(stage, folder)
        command = Command(*words, environment={PACE: rng.choice(PACES)})
        moment = time.monotonic() + rng.uniform(0, seconds)
        while command.running() and time.monotonic() < moment:
            time.sleep(0.001)
        leave(rng.choice((0, 0, 0, 4096, 20_480, 102_400, 409_600, 1_048_576)))
        accepted = command.wait().accepted()
        leave(None)
        check_resumed(box, stage, words, out)
    return accepted


STATEFUL = (*("rooms", "ensemble", "sequential", "climbers", "options", "meta", "descent", "audit", "ppo", "dqn"),)
GROWING = ("/numbers", "/told/numbers", "/agent/logged")  # dicts of numbers to log, which have no fixed names
LONGER = ("rows", "items", "drop item", "number")  # what only a value may tell: a list may have any length


def begun(box: Box, stage: Stage) -> Path:
    """The draft of a stage that was stopped behind its first checkpoints."""
    kept = box.whole / f"begun-{stage.name}"
    _whole, seconds = box.undisturbed(stage)
    while not kept.exists():
        words, out = box.command(stage, box.fresh())
        command, moment = Command(*words, environment={PACE: "0"}), time.monotonic() + seconds
        while command.running() and not (command_has(out) and time.monotonic() > moment):
            time.sleep(0.001)
        command.send(signal.SIGTERM)
        command.wait()
        if command_has(out):
            draft_folder(out).rename(kept)
        seconds *= 0.8
    return kept


def command_has(out: Path) -> bool:
    """Whether a checkpoint is kept."""
    return any(draft_folder(out).glob(f"{FOLDER}/*.safetensors"))


def checkpoints(box: Box, rng: Rng, case: int) -> bool:
    """A checkpoint with a right checksum in which one thing is not what the stage keeps; then a resume."""
    stage = STAGES[STATEFUL[case % len(STATEFUL)]]
    kept = begun(box, stage)
    words, out = box.command(stage, box.fresh())
    shutil.copytree(kept, draft_folder(out))
    path = rng.choice(sorted(draft_folder(out).glob(f"{FOLDER}/*.safetensors")))
    state = Checkpoints(path).load() or {}
    how, where = state_changed(state, rng)
    Checkpoints(path).save(state)
    try:
        accepted = run(*words, "--resume").accepted()
    except Bad as bad:
        raise Bad(f"{stage.name}, {how} at {where}: {bad}") from None
    if accepted and how not in LONGER and not where.startswith(GROWING):
        raise Bad(f"{stage.name}, {how} at {where}: accepted")
    if not accepted and not command_has(out):
        raise Bad(f"{stage.name}, {how} at {where}: refused, and the checkpoint is gone")
    return accepted


ATTACKS = {
    "TERM": (signal.SIGTERM,),
    "INT INT": (signal.SIGINT, 0.0, signal.SIGINT),
    "INT 1ms INT": (signal.SIGINT, 0.001, signal.SIGINT),
    "INT 30ms INT": (signal.SIGINT, 0.03, signal.SIGINT),
    "INT 200ms INT": (signal.SIGINT, 0.2, signal.SIGINT),
    "TSTP CONT": (signal.SIGTSTP, 0.3, signal.SIGCONT),
    "HUP": (signal.SIGHUP,),
    "PIPE": (signal.SIGPIPE,),
    "QUIT": (signal.SIGQUIT,),
    "TERM INT": (signal.SIGTERM, 0.01, signal.SIGINT),
}
DEADLY = [-number for number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGINT, signal.SIGTERM)]  # as they should


def signals(box: Box, rng: Rng, case: int) -> bool:
    """Signals at random moments, to a stage or to all its processes; a few of them, then it is gone on with."""
    stage, folder = pick(case), box.fresh()
    _whole, seconds = box.undisturbed(stage)
    words, out = box.command(stage, folder)
    for _ in range(rng.choice((1, 2, 3))):
        name, anew, group = rng.choice([*ATTACKS]), rng.random() < 0.3, rng.random() < 0.5
        command = Command(*words, "--resume", anew=anew, environment={PACE: rng.choice(PACES)})
        moment = time.monotonic() + rng.uniform(0, seconds + 2.5 * anew)
        while command.running() and time.monotonic() < moment:
            time.sleep(0.001)
        for what in ATTACKS[name]:
            if isinstance(what, float):
                time.sleep(what)
            else:
                command.send(what, group)
        ended = command.wait()
        try:
            ended.accepted(128 + signal.SIGINT, 128 + signal.SIGTERM, *DEADLY)
            check_whole(out)
        except Bad as bad:
            raise Bad(f"{stage.name}, {name}{' to all' * group}{', begun anew' * anew}: {bad}") from None
    check_resumed(box, stage, words, out)
    return True


TURNED = r"""
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
static long turned(void) {
    long seconds = 0;
    FILE *file = fopen(getenv("TURNED"), "r");
    if (file) { if (fscanf(file, "%ld", &seconds) != 1) seconds = 0; fclose(file); }
    return seconds;
}
int clock_gettime(clockid_t clock, struct timespec *now) {
    int failed = syscall(SYS_clock_gettime, clock, now);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += turned();
    return failed;
}
int gettimeofday(struct timeval *now, void *zone) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    now->tv_sec = exact.tv_sec, now->tv_usec = exact.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *now) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    return now ? (*now = exact.tv_sec) : exact.tv_sec;
}
"""  # what setting the clock changes: the time of day, not the monotonic one; libfaketime breaks time.sleep
DAY = 86_400

FULL = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>
static long count = 0;
static int full(const char *path) {
    const char *under = getenv("FULL_UNDER"), *log = getenv("FULL_LOG"), *once = getenv("FULL_ONCE");
    if (!under || !path || strncmp(path, under, strlen(under))) return 0;
    long at = atol(getenv("FULL_AT")), now = __sync_add_and_fetch(&count, 1);
    int file = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_APPEND, 0);
    syscall(SYS_write, file, ".", 1);
    syscall(SYS_close, file);
    if (once ? now != at : now < at) return 0;
    errno = ENOSPC;
    return 1;
}
static int full_at(int file) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    return length > 0 && (path[length] = 0, full(path));
}
#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
ssize_t write(int file, const void *data, size_t size) { return full_at(file) ? -1 : NEXT(write)(file, data, size); }
int mkdir(const char *path, mode_t mode) { return full(path) ? -1 : NEXT(mkdir)(path, mode); }
int rename(const char *one, const char *other) { return full(other) ? -1 : NEXT(rename)(one, other); }
int fsync(int file) { return full_at(file) ? -1 : NEXT(fsync)(file); }
#define OPEN(name) int name(const char *path, int flags, ...) { \
    va_list more; va_start(more, flags); mode_t mode = va_arg(more, int); va_end(more); \
    return (flags & O_CREAT) && full(path) ? -1 : NEXT(name)(path, flags, mode); }
OPEN(open) OPEN(open64)
"""  # a disk that is full from some write on, or refuses just one of them, below a folder


def preloaded(source: str, library: Path) -> Path:
    """A C source as a library to load in front of others."""
    if not library.exists():
        compiler = ["cc", "-shared", "-fPIC", "-o", str(library), "-x", "c", "-", "-ldl"]
        subprocess.run(compiler, input=source.encode(), check=True)
    return library


def clock(box: Box, rng: Rng, case: int) -> bool:
    """The clock set back and forward while a stage, each fifth time a sweep, runs."""
    folder, turned = box.fresh(), box.case / "clock"
    turned.write_text("0")
    library = preloaded(TURNED, box.root / "turned.so")
    faked = {"LD_PRELOAD": str(library), "TURNED": str(turned), PACE: "0.05"}
    sweeps = case % 5 == 4
    if sweeps:
        toy, out, whole = folder / "toy.toml", folder / "sweep", box.whole / "sweep"
        toy.write_text(TOY)
        words = ["sweep", str(toy), "--out", str(out), "-q"]
        if not whole.exists() and not Command("sweep", toy, "--out", whole, "-q", anew=True).wait().accepted():
            raise RuntimeError("the sweep does not end")
        seconds = 20.0
    else:
        stage = pick(rng.randrange(9))
        whole, seconds = box.undisturbed(stage)
        words, out = box.command(stage, folder)
    command, saved = Command(*words[: None if sweeps else -1], anew=True, environment=faked), set()
    said = ""
    after = time.monotonic() + rng.uniform(1, seconds)
    while command.running():
        time.sleep(0.01)
        if time.monotonic() > after:
            turned.write_text(str(rng.choice((3650 * DAY, -3650 * DAY, -20_000 * DAY, 3600, -3600, -2, 0))))
            after = time.monotonic() + rng.uniform(0.2, seconds)
            if sweeps and (out / "sweep.json").exists():
                status = Command("sweep", "--out", out, "--status", anew=True, environment=faked)
                status.wait().accepted()
                said += status.output()
        for path in draft_folder(out).glob(f"{FOLDER}/*.safetensors"):
            with suppress(OSError):
                saved.add(path.stat().st_mtime_ns)
    ended = command.wait()
    if (
        ended.code
        or "Traceback" in ended.words
        or "-" in "".join(line.partition("(")[2] for line in ended.words.splitlines() if " left)" in line)
        or "about -" in said
    ):
        raise Bad(f"ended with {ended.code}: {ended.words} {said}")
    if sweeps:
        if (out / "results.csv").read_bytes() != (whole / "results.csv").read_bytes():
            raise Bad("the sweep's results differ")
        return True
    if stage.name in ("options", "meta", "ppo", "dqn") and len(saved) < 3:
        raise Bad(f"{len(saved)} checkpoints of {stage.name}")
    if differ := unlike(stage, whole, out):
        raise Bad(f"{stage.name}: {differ} differ")
    return True


def surroundings(box: Box, rng: Rng, case: int) -> bool:
    """Whatever lies in the current folder, which is the home folder too: the same bytes as without it."""
    folder = box.fresh() / "around"
    folder.mkdir()
    environment = hostile.around(folder, rng) | {"XDG_CACHE_HOME": str(box.root / "cache"), PACE: "1e9"}
    if case % 2:  # figures, or a stage that starts processes
        kind = rng.choice(("svg", "png", "pdf"))
        whole, out = box.whole / f"figures-{kind}", box.case / "made"
        words: list[object] = ["report", box.ready(*TRAINED, evaluated=True), "--format", kind, "--figures"]
        if not whole.exists() and not Command(*words, whole).wait().accepted():
            raise RuntimeError("the figures cannot be drawn")
        words.append(out)
    else:
        stage = STAGES[rng.choice(("rooms", "ensemble", "ppo"))]
        whole, out = box.undisturbed(stage)[0], box.case / f"{stage.name}{stage.suffix}"
        words = [*box.command(stage, box.case)[0]]
    before = entries(folder)
    ended = Command(*words, anew=True, environment=environment, folder=folder).wait()
    if not ended.accepted() or (case % 2 == 0 and ended.words):
        raise Bad(f"obeyed: {ended.words[-400:]}")
    if differ := differences(whole, out):
        raise Bad(f"{words[0]}: {differ} differ")
    if changed := {name for name in entries(folder) ^ before if "fontlist" not in name}:  # matplotlib's own cache
        raise Bad(f"wrote {sorted(changed)[:3]}")
    return True


def writers(box: Box, name: str) -> tuple[list[str], Path]:
    """The words of a command that writes, and where, in a fresh folder; what it reads lies elsewhere."""
    folder = box.fresh()
    if name in ("evaluation", "report", *STATEFUL, "data"):
        return box.command({"evaluation": EVALUATION, "report": REPORT}.get(name) or STAGES[name], folder)
    whole = box.ready(*TRAINED, evaluated=True)
    arrays = box.whole / "arrays.npz"
    if not arrays.exists() and not run("export", whole / "data.h5", "--out", arrays).accepted():
        raise RuntimeError("the data cannot be exported")
    other = box.whole / "other"
    if not other.exists():
        shutil.copytree(whole, other)
    commands: dict[str, tuple[list[Any], str]] = {
        "import": (["import", arrays, "--out"], "made.h5"),
        "arrays": (["export", whole / "data.h5", "--out"], "made.npz"),
        "episodes": (["export", whole / "meta", "--out"], "made-v0"),
        "compare": (["compare", whole, other, "--out"], "made"),
        "figures": (["report", whole, "--figures"], "made"),
        "sheets": (["show", whole / "data.h5", "--pictures"], "made"),
    }
    words, made = commands[name]
    return [*map(str, words), str(folder / made)], folder / made


CHEAP = ("data", "import", "arrays", "evaluation", "report", "episodes", "compare", "figures", "sheets")
COSTLY = ("ensemble", "options", "ppo", "rooms", "meta", "audit", "dqn", "sequential")


def writes(box: Box, rng: Rng, case: int) -> bool:
    """A disk that is full from one write of a command on, or refuses one alone; then there is room, and it is resumed.

    Each tenth case is of a command that trains. Nothing hidden may stay but a checkpoint that the message names.
    """
    costly, cheap = COSTLY[case // 10 % len(COSTLY)], CHEAP[(case - case // 10) % len(CHEAP)]
    name = costly if case % 10 == 9 else cheap
    counts = box.root / f"{name}.writes"
    words, out = writers(box, name)
    log = box.root / "log"
    log.write_bytes(b"")
    faked = {PACE: "0.05", "FULL_UNDER": str(box.case), "FULL_LOG": str(log)}
    if not counts.exists():
        if not Command(*words, environment={**faked, "FULL_AT": str(10**9)}).wait().accepted():
            raise RuntimeError(f"{name} does not end")
        counts.write_text(str(log.stat().st_size))
        words, out = writers(box, name)
    at, once = 1 + rng.randrange(int(counts.read_text())), rng.random() < 0.3
    ended = Command(*words, environment={**faked, "FULL_AT": str(at), **({"FULL_ONCE": "1"} if once else {})}).wait()
    if name in ("import", "episodes"):  # which say before what is odd about the data, and how far they are
        ended = dataclasses.replace(ended, words=ended.words[ended.words.rstrip().rfind("\n") + 1 :])
    where = f"{name}, {'only ' * once}write {at} of {counts.read_text()}"
    try:
        accepted = ended.accepted()
        left = sorted(path for path in entries(box.case) if any(part.startswith(".") for part in Path(path).parts))
        if command_has(out) and "--resume" not in ended.words:
            raise Bad(f"a checkpoint is left, and not named: {ended.words}")
        if left and not command_has(out):
            raise Bad(f"left {left[:3]}: {ended.words}")
        check_whole(out) if name not in ("arrays", "figures", "sheets", "episodes") else None
        if name == "episodes" and not accepted:  # whole, but not known to be on the disk; no --force replaces it
            shutil.rmtree(out, ignore_errors=True)
        resumed = ["--resume"] if command_has(out) else ["--force"] if out.exists() and name != "sheets" else []
        if not accepted and not (again := run(*words, *resumed)).accepted():
            raise Bad(f"cannot be made then: {again.words}")
        if hidden := [path for path in entries(box.case) if Path(path).name.startswith(".")]:
            raise Bad(f"at the end there are {hidden[:3]}")
    except Bad as bad:
        raise Bad(f"{where}: {bad}") from None
    return accepted


def entries(folder: Path) -> set[str]:
    """Everything that is in a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def read(made: hostile.Made, box: Box) -> bool:
    """Have every command that reads a hostile file read it; whether none refused."""
    accepted, before = True, entries(box.case)
    for words in made.commands:
        ended = run(*words)
        if new := sorted(name for name in entries(box.case) ^ before if not name.startswith(made.outputs)):
            raise Bad(f"{made.name}, {words[0]}: wrote elsewhere: {new[:3]}")
        with suppress(OSError):
            for part in sorted({Path(word) for word in map(str, words) if str(word).startswith(str(box.case))}):
                if part.name.startswith("made") and part.suffix != ".npz" and words[0] != "verify":
                    check_whole(part)
        try:
            accepted &= ended.accepted()
            box.most = max(box.most, ended.memory)
            if made.size < SMALL and ended.memory > MEMORY:
                raise Bad(f"took {ended.memory / 1e9:.1f} GB")
            if made.size < SMALL and "memory does not suffice" in ended.words:  # of a limit that it was run under
                raise Bad(f"wanted too much memory: {ended.words}")
        except Bad as bad:
            raise Bad(f"{made.name}, {words[0]}: {bad}") from None
    return accepted


def files(make: Callable[[Box, Rng, int], hostile.Made]) -> Callable[[Box, Rng, int], bool]:
    """A family of hostile files."""

    def family(box: Box, rng: Rng, case: int) -> bool:
        box.fresh()
        return read(make(box, rng, case), box)

    return family


FAMILIES: dict[str, Callable[[Box, Rng, int], bool]] = {
    "disk": disk,
    "checkpoints": checkpoints,
    "writes": writes,
    "signals": signals,
    "clock": clock,
    "surroundings": surroundings,
    "minari": files(hostile.minari),
    "images": files(hostile.images),
    "arrays": files(hostile.arrays),
    "hdf5": files(hostile.data_files),
    "hdf5 in artefacts": files(hostile.stored_arrays),
    "json": files(hostile.texts),
    "toml": files(hostile.tables),
}


RUN_FREE = ("minari", "images", "arrays", "toml")  # families that need no run


def attack(box: Box, name: str, cases: range, seed: int) -> dict[str, Any]:
    """The cases of a family, one after the other, until Ctrl-C."""
    counts: Counter[str] = Counter()
    failures, slowest, box.most = [], 0.0, 0
    for case in cases:
        began = time.monotonic()
        try:
            counts["accepted" if FAMILIES[name](box, random.Random(f"{seed} {name} {case}"), case) else "refused"] += 1
            box.check_outside()
        except KeyboardInterrupt:
            break
        except Bad as bad:
            counts["bad"] += 1
            failures.append(f"{name} case {case}: {bad}")
            print(failures[-1], file=sys.stderr, flush=True)
        slowest = max(slowest, time.monotonic() - began)
    outcomes = {kind: counts[kind] for kind in ("refused", "accepted", "bad")}
    numbers = {"slowest": f"{slowest:.1f} s", "memory": f"{box.most / 1e9:.1f} GB"}
    return {"family": name, "cases": sum(counts.values()), **outcomes, **numbers, "failures": failures}


def measure() -> None:
    """How much memory a command has that does nothing: what it shares with this process is not what it takes."""
    global BASELINE
    BASELINE = run("--version").memory


def prepare() -> None:
    """Load what commands load, so that those forked from this process need not."""
    import torch

    import hypogoal.stages.evaluate
    import hypogoal.stages.report
    import hypogoal.stages.train_baseline
    import hypogoal.stages.train_meta  # noqa: F401

    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    measure()


def main() -> int:
    """Run the attacks; exit code 1 when a case was bad."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", action="append", choices=FAMILIES)
    parser.add_argument("--cases", type=int, default=20, help="of each family")
    parser.add_argument("--case", type=int, help="this one alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the rows here too")
    parser.add_argument("--folder", type=Path, help="where to work; a temporary one where not given")
    given = parser.parse_args()
    folder = (given.folder or Path(tempfile.mkdtemp(prefix="attacks-"))).resolve()
    if "writes" in (given.family or FAMILIES) and "full.so" not in os.environ.get("LD_PRELOAD", "") and COMPILER:
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["LD_PRELOAD"] = str(preloaded(FULL, folder / "full.so"))  # for commands, which are forked from here
        os.execv(
            sys.executable, [sys.executable, "-m", "tests.attacks.attacks", *sys.argv[1:], "--folder", str(folder)]
        )
    prepare()
    box, rows = Box(folder), []
    print("| family | cases | refused in one line | accepted | bad | slowest | memory |\n" + "|---" * 7 + "|")
    for name in given.family or FAMILIES:
        if (name == "disk" and os.geteuid()) or (name in ("clock", "writes") and not COMPILER):
            continue
        cases = range(given.cases) if given.case is None else range(given.case, given.case + 1)
        rows.append(attack(box, name, cases, given.seed))
        print(f"| {' | '.join(str(value) for key, value in rows[-1].items() if key != 'failures')} |", flush=True)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    bad = sum(row["bad"] for row in rows)
    if given.folder is None and not bad:
        shutil.rmtree(folder)
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
