"""Make parts of the reference by the code that PYTHONPATH names: see README.md beside this file."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import tables
from parts import CHECKOUT, PARTS


def commit() -> str:
    """Of the code that runs, with a + where files of the package were changed since."""
    git = ("git", "-C", str(CHECKOUT))
    head = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain", "hypogoal"], capture_output=True, text=True).stdout
    return f"{head}+" if changed else head


def make(name: str, work: Path, folder: Path) -> None:
    """Write one part's table, and note what made it."""
    began = time.process_time()
    tables.write(folder / f"{name}.csv.gz", PARTS[name].make(work))
    known = tables.record(folder) | {name: {"code": commit(), "machine": tables.machine()}}
    text = json.dumps(dict(sorted(known.items())), indent=1)
    (folder / tables.RECORD).write_text(text + "\n", encoding="utf-8")
    print(f"{name}: {time.process_time() - began:.1f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="which parts; all where none is named")
    parser.add_argument("--to", type=Path, default=tables.FOLDER, help="where tables are written")
    chosen = parser.parse_args()
    chosen.to.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        for name in chosen.names or PARTS:
            make(name, Path(work), chosen.to)


if __name__ == "__main__":
    main()
