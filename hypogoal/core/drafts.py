"""Drafts: the hidden folder beside an output in which a stage works until the output is whole (Spec A8, G1).

``.NAME.partial/`` has ``files/`` (what will be the output), ``checkpoint/`` (see ``core.checkpoints``), ``begun.json``
(settings, seed, inputs, versions) and ``lock``, which the kernel holds for the process that works there and lets go of
when that process dies, however it does.
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
from hypogoal.core.files import FRESH, parse_json, read_json, replace_text, sync
from hypogoal.core.locks import is_there, remove_left_over, try_lock

PARTIAL = ".partial"
FILES, BEGUN, LOCK, OLD = "files", "begun.json", "lock", ".old"
PATIENCE_SECONDS = 2.0  # for whoever is just letting go
COMMAND: ContextVar[tuple[str, ...]] = ContextVar("COMMAND", default=())  # a program's call, where it was no command
GO_ON = "give the same command with --resume to go on"


@dataclass(frozen=True)
class Draft:
    """A draft that this process works on: the folder to fill, and the command line that began it, without --resume."""

    files: Path
    command: list[str]


def place_of(out: Path) -> Path:
    """An output by a name of its own, also where it was called ``.`` or is a link: the work goes where that leads."""
    return out.resolve() if out.is_symlink() or not out.name or ".." in out.parts else out


def draft_folder(out: Path) -> Path:
    """Where the draft of an output lies."""
    out = place_of(out)
    return out.with_name(f".{out.name}{PARTIAL}")


def check_replaceable(out: Path, *, force: bool, resume: bool = False) -> None:
    """Refuse (``UserError``) to replace what is there, unless what is unfinished beside it was begun with ``force``."""
    if out.exists() and not force and not (resume and unfinished(out)):
        raise UserError("the output exists already", out, "Choose another --out, or give --force to replace it.")


def check_free(out: Path, *, force: bool, resume: bool) -> None:
    """Refuse (``UserError``), before any work, to write what another process writes, or to lose what is unfinished."""
    folder = draft_folder(out)
    if folder.is_dir() and os.access(folder, os.W_OK):
        with sole_writer(out):
            _check_unfinished(out, force=force, resume=resume)


def unfinished(out: Path) -> bool:
    """Whether something was begun for ``out`` that can be gone on with."""
    folder = draft_folder(out)
    checkpoints = (folder / FOLDER).glob("*.safetensors")
    return (folder / BEGUN).is_file() and (folder / FILES).is_dir() and any(checkpoints)


@contextlib.contextmanager
def draft(out: Path, identity: dict[str, Any], *, force: bool = False, resume: bool = False) -> Iterator[Draft]:
    """Work on ``out``: a fresh draft, or with ``resume``, which ``force`` does not undo, the one begun before with a
    checkpoint.

    ``identity`` is what makes it what it is; a draft begun with another is not gone on with. When the block raises, the
    draft stays where it has a checkpoint and is removed otherwise. Another process at work on ``out``, or something
    unfinished that was begun otherwise, or of which it was not said what to do with it, is a ``UserError``.
    """
    folder = draft_folder(out)
    called = Path(sys.argv[0]).name
    words = COMMAND.get() or ("hypogoal" if called == "__main__.py" else called, *sys.argv[1:])
    command = [word for word in words if word != "--resume"]  # of which nothing depends
    fresh = {"identity": identity, "command": command}
    fresh = parse_json(
        json.dumps(fresh), out, "the command, settings and names are", "Give names in UTF-8, and finite numbers."
    )
    with sole_writer(out):
        _settle(out)
        check_replaceable(out, force=force, resume=resume)  # by now: another process may have made it since
        _check_unfinished(out, force=force, resume=resume)
        if resume and unfinished(out):
            begun = _begun(folder)
            do = "Resume it with what it was begun with, or give --force and no --resume to begin anew."
            check_same(begun["identity"], fresh["identity"], out, "what is unfinished there was begun", do)
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
    """Rename what was made, a folder or a file, to ``out``; what stood there is moved aside first and removed last."""
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
    """Finish what :func:`put_in_place` had begun: what was moved aside comes back where nothing took its place."""
    out = place_of(out)
    old = out.with_name(f".{out.name}{OLD}")
    if old.exists() and not out.exists():
        old.rename(out)
    _remove(old)


def sweep_up(folder: Path) -> None:
    """Remove from a folder what processes left that were killed while they wrote: files that had no name yet, and
    drafts without a checkpoint, behind which what was moved aside comes back. Whoever writes there next does so.

    What a living process writes it has locked; where the system cannot lock, all of it stays.
    """
    with contextlib.suppress(OSError):  # it may not be there, or not be read
        for name in filter(lambda name: name.startswith("."), os.listdir(folder)):
            with contextlib.suppress(OSError):  # another process removes it, or only another user may
                if FRESH.fullmatch(name):
                    remove_left_over(folder / name)
                elif name.endswith(PARTIAL) and not (out := folder / name[1 : -len(PARTIAL)]).is_symlink():
                    _sweep_draft(folder / name, out)


def _sweep_draft(folder: Path, out: Path) -> None:
    expected = {FILES, FOLDER, BEGUN, LOCK}
    lock = folder / LOCK
    if any(path.is_symlink() for path in (folder, lock)) or not lock.is_file():
        return
    if not all(name in expected or FRESH.fullmatch(name) for name in os.listdir(folder)):
        return  # it is no draft
    with lock.open("r+b") as file:
        if try_lock(file) and is_there(file, lock) and not unfinished(out):
            _settle(out)
            _clear(folder)


def _clear(folder: Path) -> None:
    """Remove a draft, its lock last: whoever gets that finds nothing of this one, and loses nothing to it."""
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
        raise UserError(
            "an unfinished output is there", out, "Give --resume to go on with it, or --force to begin anew."
        )


def check_same(before: dict[str, Any], now: dict[str, Any], out: Path, what: str, do: str) -> None:
    """Refuse (``UserError``) to go on with what was made of something else, naming the first thing that differs.

    ``what`` was done with the former, for the message ("what is there was made"); ``do`` is what to do about it.
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
        raise UserError(f"{what} with {other}", out, do)


def _that_matters(identity: dict[str, Any]) -> dict[str, Any]:
    """What results depend on: not on how many processes there are, nor on how their manifest is written."""
    identity, config = {key: value for key, value in identity.items() if key != "format"}, identity.get("config")
    return identity if not isinstance(config, dict) else {**identity, "config": {**config, "workers": None}}


def check_complete(before: Mapping[str, Any], now: Mapping[str, Any], out: Path) -> Complete:
    """What to raise where ``--resume`` finds ``out`` complete; a ``UserError`` where it was made of something else.

    ``before`` and ``now`` have ``config``, ``versions`` and whatever else makes it, such as a manifest. Settings that
    only one of the two has are those of another hypogoal; other versions are said and no more, since nothing is gone on
    with.
    """
    now = json.loads(json.dumps(now))
    keys = [key for key in now if key not in ("config", "versions")]
    settings = sorted(before["config"].keys() & now["config"].keys())
    old, new = (
        {"config": {key: identity["config"][key] for key in settings}, **{key: identity[key] for key in keys}}
        for identity in (before, now)
    )
    do = "Give --force and no --resume, or write elsewhere."
    check_same(old, new, out, "what is complete there was made", do)
    if now["config"] and not settings:
        raise UserError("what is complete there was made with other settings", out, do)
    versions = before.get("versions")
    recorded = versions.items() if isinstance(versions, dict) else ()
    others = [f"{name} {version}" for name, version in recorded if now["versions"].get(name) != version]
    return Complete(out, f"made with {', '.join(others)}" if others else "")


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


@contextlib.contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Write ``out`` as the only process that does (else a ``UserError``): the lock on its draft is held.

    The draft's folder is made where there is none and removed if it stays empty.
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
                with contextlib.suppress(OSError):  # a full disk: it is for others to read, and stays empty
                    file.truncate(0)
                    file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
                try:
                    sweep_up(folder.parent)
                    yield
                finally:
                    with contextlib.suppress(OSError):  # unless it is another's by now, who made it anew
                        if is_there(file, folder / LOCK) and os.listdir(folder) == [LOCK]:
                            _clear(folder)
                return
            file.seek(0)
            owner = file.read(200).decode(errors="replace") or "another process"
        if time.monotonic() >= until:
            raise UserError(f"{owner} is writing this", out, "Wait until it is done, or choose another --out.")
        time.sleep(0.05)


def _check_own(folder: Path) -> None:
    """Refuse a draft with links, pipes or devices in it: no stage makes any, and writing would go where they lead."""
    inside = ((place, name) for place, folders, names in os.walk(folder) for name in (*folders, *names))
    for path in (folder, *(Path(place, name) for place, name in inside)):
        with contextlib.suppress(FileNotFoundError):  # its owner removes it
            mode = path.lstat().st_mode
            if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                raise UserError(
                    "the unfinished output holds a link, pipe or device, which no stage makes", path, "Remove it."
                )
