"""Files that other programs wrote: which there are."""

from collections import Counter
from collections.abc import Collection
from glob import iglob
from pathlib import Path


def files_of(folder: Path, suffixes: Collection[str], left: Counter[str]) -> list[Path]:
    """The visible files with these suffixes in a folder and those below it, sorted, links followed.

    ``left`` counts the others by suffix.
    """
    taken = []
    for name in iglob("**/*", root_dir=folder, recursive=True):
        file = folder / name
        suffix = file.suffix.lower()
        if file.is_dir():
            continue
        if suffix in suffixes:
            taken.append(file)
        else:
            left[suffix or file.name] += 1
    return sorted(taken)
