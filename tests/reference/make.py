"""Make parts of the reference by the code that PYTHONPATH names: see README.md beside this file."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported

import argparse
import json
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import tables
from parts import CHECKOUT, PARTS


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="which parts; all where none is named")
    parser.add_argument("--to", type=Path, default=tables.FOLDER, help="where tables are written")
    parser.add_argument("--work", type=Path, help="folder for what parts share; a temporary one by default")
    return parser.parse_args()


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


def made(name: str, work: Path, folder: Path) -> bool:
    """Whether a part could be made; the others are made all the same."""
    try:
        make(name, work, folder)
    except Exception:  # noqa: BLE001, told with its traceback
        traceback.print_exc()
        return False
    return True


def main() -> str | None:
    chosen = arguments()
    chosen.to.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = chosen.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        failed = [name for name in chosen.names or PARTS if not made(name, work, chosen.to)]
    return f"not made: {', '.join(failed)}" if failed else None


if __name__ == "__main__":
    sys.exit(main())
