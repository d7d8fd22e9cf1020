"""Printed commands: they can be pasted into a shell and work.

Words are quoted. If a file that the command reads names user code, ``HYPOGOAL_TRUST`` is put in front for code that the
user allowed in this process; about other code, perhaps a stranger's, the text asks whether the user trusts it. The
variable is put in front even if it is set now, since it may be set for this command only.
"""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hypogoal.core.artefacts import MANIFEST, find_input, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.files import visible
from hypogoal.core.hdf5 import attribute, open_hdf5
from hypogoal.core.own_code import allowed_before, permission

OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")  # module:object
GENERATIONS = 3  # of inputs that are followed: options, the options that these continue, their ensemble


def command(*words: object) -> str:
    """The command ``hypogoal *words`` as one would type it next."""
    return _typed(words, [name for name in _named(words) if name in allowed_before()])


def advice(lead: str, *words: object) -> str:
    """``lead`` and the command that an error advises: 'First run: hypogoal evaluate runs/mine'."""
    names = _named(words)
    unsure = [name for name in names if name not in allowed_before()]
    lead += f", if you trust {' and '.join(unsure)}" if unsure else ""
    return f"{lead}: {_typed(words, names)}"


def _typed(words: tuple[object, ...], names: list[str]) -> str:
    line = shlex.join(["hypogoal", *map(str, words)])
    return f"{permission(names)} {line}" if names else line


def _named(words: tuple[object, ...]) -> list[str]:
    """User code named in the files among the words."""
    return [*dict.fromkeys(name for word in words[1:] for name in _named_at(Path(str(word))))]


def _named_at(path: Path) -> Iterator[str]:
    """User code named in a data file, an artefact or the artefacts of a run."""
    try:
        if path.suffix == ".h5" and path.is_file():
            with open_hdf5(path, "the data file", "") as file:
                yield from _names(attribute(file, "domain"))
        elif path.is_dir():
            for manifest in [path / MANIFEST] if (path / MANIFEST).is_file() else visible(path, MANIFEST):
                yield from _named_by(manifest.parent, GENERATIONS)
    except (UserError, OSError, ValueError):  # reported by whoever reads the file
        return


def _named_by(folder: Path, generations: int) -> Iterator[str]:
    manifest = open_artefact(folder).manifest
    yield from _names(manifest["config"])
    for entry in manifest["inputs"] if generations else ():
        path = None if entry["kind"] == "data" else find_input(folder, entry)[0]
        if path is not None:
            yield from _named_by(path, generations - 1)


def _names(value: Any) -> Iterator[str]:
    if isinstance(value, str) and OWN.fullmatch(value):
        yield value
    elif isinstance(value, dict):
        yield from (name for part in value.values() for name in _names(part))
