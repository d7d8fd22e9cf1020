"""``python -m benchmarks NAME [...]``: the same as ``python -m benchmarks.NAME [...]``."""

import runpy
import sys
from pathlib import Path

NAMES = sorted(
    path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in ("__init__", "__main__", "timing")
)

if len(sys.argv) < 2 or sys.argv[1] not in NAMES:
    print(f"usage: python -m benchmarks {{{','.join(NAMES)}}} [--help]", file=sys.stderr)
    raise SystemExit(2)
sys.argv[:2] = [f"python -m benchmarks {sys.argv[1]}"]
name = sys.argv[0].rpartition(" ")[2]
runpy.run_module(f"benchmarks.{name}", run_name="__main__")
