"""Drafts: the hidden folder beside an output in which a stage works until the output is whole (Spec A8, G1).

``.NAME.partial/`` has ``files/`` (the future output), ``checkpoint/`` (see ``core.checkpoints``), ``begun.json``
(settings, seed, inputs, versions) and ``lock``, a kernel lock of the working process that ends when the process does.
"""

import contextlib
import json
import os
import shutil
import socket
import stat
import sys
import time
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypogoal.core.checkpoints import FOLDER
from hypogoal.core.errors import Complete, UserError
from hypogoal.core.files import FRESH, open_file, parse_json, read_json, replace_text, sync
from hypogoal.core.locks import is_there, remove_left_over, try_lock

PARTIAL = ".partial"
FILES, BEGUN, LOCK, OLD = "files", "begun.json", "lock", ".old"
PATIENCE_SECONDS = 2.0  # a process that is just ending may still hold the lock
COMMAND: ContextVar[tuple[str, ...]] = ContextVar("COMMAND", default=())  # a program's call in place of a command
GO_ON = "give the same command with --resume to continue"


@dataclass(frozen=True)
class Draft:
    """This process's draft: the folder to fill, and the command line that began it, without ``--resume``."""

    files: Path
    command: list[str]


def place_of(out: Path) -> Path:
    """The output's path with a proper name, links followed, also for ``.`` and ``..``."""
    return out.resolve() if out.is_symlink() or not out.name or ".." in out.parts else out


def draft_folder(out: Path) -> Path:
    """The folder of an output's draft."""
    out = place_of(out)
    return out.with_name(f".{out.name}{PARTIAL}")


def check_replaceable(out: Path, *, force: bool, resume: bool = False) -> None:
    """Refuse (``UserError``) to replace an existing output, unless a draft that replaces it is resumed."""
    if out.exists() and not force and not (resume and unfinished(out)):
        raise UserError("the output exists already", out, "Choose another --out, or give --force to replace it.")


def check_free(out: Path, *, force: bool, resume: bool) -> None:
    """Refuse (``UserError``), before any work, an output that another process writes or that would lose a draft."""
    folder = draft_folder(out)
    if folder.is_dir() and os.access(folder, os.W_OK):
        with sole_writer(out):
            _check_unfinished(out, force=force, resume=resume)


def unfinished(out: Path) -> bool:
    """Whether ``out`` has a draft that can be resumed."""
    folder = draft_folder(out)
    checkpoints = (folder / FOLDER).glob("*.safetensors")
    return (folder / BEGUN).is_file() and (folder / FILES).is_dir() and any(checkpoints)


def drafts_in(path: Path) -> dict[Path, bool]:
    """The outputs at or below a path that have a draft, and whether, as its lock says, a process works on it."""
    drafts = {}
    for folder in (draft_folder(path), *sorted(path.rglob(f".*{PARTIAL}"))):
        with contextlib.suppress(UserError), open_file(folder / LOCK, "the lock is", "Remove it.") as file:
            if (folder / BEGUN).is_file():
                drafts[folder.with_name(folder.name[1 : -len(PARTIAL)])] = try_lock(file, shared=True) is False
    return drafts


@contextlib.contextmanager
def draft(out: Path, identity: dict[str, Any], *, force: bool = False, resume: bool = False) -> Iterator[Draft]:
    """Work on ``out`` in a fresh draft or, with ``resume``, in one that has a checkpoint, even if ``force`` is given.

    ``identity`` determines the output; a draft of another identity is not resumed. If the block raises, the draft stays
    if it has a checkpoint and is removed otherwise. A ``UserError`` if another process works on ``out``, or if a draft
    exists that has another identity, or neither ``resume`` nor ``force`` is given.
    """
    folder = draft_folder(out)
    called = Path(sys.argv[0]).name
    words = COMMAND.get() or ("hypogoal" if called == "__main__.py" else called, *sys.argv[1:])
    command = [word for word in words if word != "--resume"]  # which changes no result
    fresh = {"identity": identity, "command": command}
    fresh = parse_json(
        json.dumps(fresh), out, "the command, settings and names are", "Give names in UTF-8, and finite numbers."
    )
    with sole_writer(out):
        _settle(out)
        check_replaceable(out, force=force, resume=resume)  # again: another process may have made it since
        _check_unfinished(out, force=force, resume=resume)
        if resume and unfinished(out):
            begun = _begun(folder)
            do = "Resume it with the same settings, or give --force and no --resume to begin anew."
            check_same(begun["identity"], fresh["identity"], out, "the unfinished output was begun", do)
        else:
            begun = fresh
        try:
            if begun is fresh:
                _begin(folder, begun)
            for place, _, _ in os.walk(folder / FILES):
                sweep_up(Path(place))
            yield Draft(folder / FILES, begun["command"])
        except BaseException as error:
            if not unfinished(out):
                _clear(folder)
            elif "--resume" not in str(error):
                error.add_note(f"the last checkpoint is kept: {GO_ON}")
            raise
        _clear(folder)


def put_in_place(finished: Path, out: Path) -> None:
    """Rename a finished folder or file to ``out``; what ``out`` was is moved aside first and removed last."""
    for path in [finished, *finished.rglob("*")]:
        sync(path)
    out = place_of(out)
    old = out.with_name(f".{out.name}{OLD}")
    if out.exists():
        out.rename(old)
    try:
        finished.rename(out)
        sync(out.parent)
    finally:
        _settle(out)


def _settle(out: Path) -> None:
    """Finish an interrupted :func:`put_in_place`: the old output comes back if nothing took its place."""
    out = place_of(out)
    old = out.with_name(f".{out.name}{OLD}")
    if old.exists() and not out.exists():
        old.rename(out)
    _remove(old)


def sweep_up(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder. Every writer calls this first.

    Files of living processes are locked and stay; on systems without locks all files stay.
    """
    with contextlib.suppress(OSError):  # missing or unreadable
        for name in filter(FRESH.fullmatch, os.listdir(folder)):
            with contextlib.suppress(OSError):  # another process removes it, or only another user may
                remove_left_over(folder / name)


def _clear(folder: Path) -> None:
    """Remove a draft, its lock last, so that the next owner of the lock finds an empty folder."""
    with contextlib.suppress(OSError):
        for path in sorted(folder.iterdir(), key=lambda path: path.name == LOCK):
            _remove(path)
        folder.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _begin(folder: Path, begun: dict[str, Any]) -> None:
    for name in (BEGUN, FOLDER, FILES):
        _remove(folder / name)
    (folder / FILES).mkdir()
    replace_text(folder / BEGUN, json.dumps(begun) + "\n")


def _begun(folder: Path) -> dict[str, Any]:
    try:
        begun = read_json(folder / BEGUN, "the unfinished output is", "Give --force to begin anew.")
        return {"identity": dict(begun["identity"]), "command": [str(word) for word in begun["command"]]}
    except (KeyError, TypeError, ValueError):
        raise UserError("the unfinished output is damaged", folder / BEGUN, "Give --force to begin anew.") from None


def _check_unfinished(out: Path, *, force: bool, resume: bool) -> None:
    if unfinished(out) and not (force or resume):
        raise UserError("an unfinished output exists", out, "Give --resume to continue it, or --force to begin anew.")


def check_same(before: dict[str, Any], now: dict[str, Any], out: Path, subject: str, do: str) -> None:
    """Refuse (``UserError``) to continue another identity, naming the first difference.

    ``subject`` begins the message ("the complete output was made"); ``do`` is what to do about it.
    """
    before, now = _that_matters(before), _that_matters(now)
    for key in {**before, **now}:
        old, new = before.get(key), now.get(key)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            key = next(name for name in {**old, **new} if old.get(name) != new.get(name))
            old, new = old.get(key), new.get(key)
        other = "other inputs" if key == "inputs" else f"{key}={_short(old)}, not {_short(new)}"
        raise UserError(f"{subject} with {other}", out, do)


def _that_matters(identity: dict[str, Any]) -> dict[str, Any]:
    """The part of an identity that results depend on: without the number of processes and the manifest's format."""
    identity, config = {key: value for key, value in identity.items() if key != "format"}, identity.get("config")
    return identity if not isinstance(config, dict) else {**identity, "config": {**config, "workers": None}}


def check_complete(before: Mapping[str, Any], now: Mapping[str, Any], out: Path) -> Complete:
    """What to raise if ``--resume`` finds ``out`` complete; a ``UserError`` if its identity is another.

    ``before`` and ``now`` have ``config`` and the rest of an identity. Settings that only one of them has are from
    another version of hypogoal and are ignored, as are other package versions, since nothing is resumed.
    """
    now = json.loads(json.dumps(now))
    settings = sorted(before["config"].keys() & now["config"].keys())
    old, new = (
        {
            **{key: identity[key] for key in now if key != "versions"},
            "config": {key: identity["config"][key] for key in settings},
        }
        for identity in (before, now)
    )
    do = "Give --force and no --resume, or write elsewhere."
    check_same(old, new, out, "the complete output was made", do)
    if now["config"] and not settings:
        raise UserError("the complete output was made with other settings", out, do)
    return Complete(out)


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


@contextlib.contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Hold the lock on the draft of ``out``; a ``UserError`` if another process does.

    The draft's folder is made if needed and removed if it stays empty.
    """
    folder = draft_folder(out)
    until = time.monotonic() + PATIENCE_SECONDS
    while True:
        _check_own(folder)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            file = (folder / LOCK).open("a+b", buffering=0)
        except FileNotFoundError:
            continue  # its owner has just removed the folder
        except OSError:
            with contextlib.suppress(OSError):
                folder.rmdir()
            raise
        with file:
            if try_lock(file) is not False and is_there(file, folder / LOCK):
                with contextlib.suppress(OSError):  # a full disk: only others read it
                    file.truncate(0)
                    file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
                try:
                    sweep_up(folder.parent)
                    yield
                finally:
                    with contextlib.suppress(OSError):  # another process may have made it anew
                        if is_there(file, folder / LOCK) and os.listdir(folder) == [LOCK]:
                            _clear(folder)
                return
            file.seek(0)
            owner = file.read(200).decode(errors="replace") or "another process"
        if time.monotonic() >= until:
            raise UserError(f"{owner} is writing this", out, "Wait until it is done, or choose another --out.")
        time.sleep(0.05)


def _check_own(folder: Path) -> None:
    """Refuse a draft with links, pipes or devices: no stage makes any, and writing would follow them."""
    inside = ((place, name) for place, folders, names in os.walk(folder) for name in (*folders, *names))
    for path in (folder, *(Path(place, name) for place, name in inside)):
        with contextlib.suppress(FileNotFoundError):  # removed by its owner meanwhile
            mode = path.lstat().st_mode
            if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                raise UserError(
                    "the unfinished output holds a link, pipe or device, which no stage makes", path, "Remove it."
                )
