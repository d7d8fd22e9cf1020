"""How far two codes are apart: ``agree.py OLD NEW``, two folders of tables by make.py, or two safetensors files.

Of each table: the largest difference between numbers, lines gone and new, texts that differ; of predictions also those
on the other side of .5 where the old log-odds are further than 1e-3 from it.
"""

import math
import sys
from pathlib import Path

import numpy as np
import tables
from safetensors.numpy import load_file

SURE = 1e-3  # log-odds


def compare_tables(old: Path, new: Path) -> str:
    before, now = tables.by_key(tables.read(old)), tables.by_key(tables.read(new))
    largest, texts, flipped = 0.0, 0, 0
    for key in before.keys() & now.keys():
        one, other = tables.as_number(before[key]), tables.as_number(now[key])
        if one is None or other is None:
            texts += before[key] != now[key]
            continue
        largest = max(largest, abs(one - other))
        if old.name.startswith("predictions") and 0 < one < 1:
            sure = abs(math.log(one / (1 - one))) > SURE
            flipped += sure and (one > 0.5) != (other > 0.5)
    gone, more = len(before.keys() - now.keys()), len(now.keys() - before.keys())
    return f"largest difference {largest:.3g}; texts {texts}, gone {gone}, new {more}, sure predictions {flipped}"


def compare_weights(old: Path, new: Path) -> str:
    before, now = load_file(old), load_file(new)
    if before.keys() != now.keys():
        return f"different arrays: {sorted(before.keys() ^ now.keys())}"
    differences = {name: float(np.abs(before[name] - now[name]).max(initial=0)) for name in before}
    name = max(differences, key=lambda name: differences[name])
    return f"largest difference {differences[name]:.3g}, of {name}"


def main(old: Path, new: Path) -> None:
    if old.suffix == ".safetensors":
        print(compare_weights(old, new))
        return
    for path in sorted(new.glob("*.csv.gz")):
        if (old / path.name).exists():
            print(f"{path.name.removesuffix('.csv.gz')}: {compare_tables(old / path.name, path)}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
