"""The reference's tables as files, where two of them part, and on which machine they were made."""

import csv
import gzip
import io
import json
from pathlib import Path

import numpy as np
import torch

FOLDER = Path(__file__).parent
RECORD = "record.json"  # of each part: which code made it, on which machine
FLAGS = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_tile")  # of the processor, that decide how it adds up

# Columns of the tables of an evaluation that have other statistics since 1.1: test_statistics.py holds them.
STATISTICS = {"iqm", "estimate", "low", "high", "difference", "outcome"}
STATISTICS |= {f"probability_{end}" for end in ("low", "high")}
STATISTICS |= {f"difference_{end}" for end in ("low", "high", "least", "most")}

Table = list[tuple[str, ...]]


def read(path: Path) -> Table:
    with gzip.open(path, "rt", encoding="utf-8", newline="") as file:
        return [tuple(row) for row in csv.reader(file)]


def write(path: Path, table: Table) -> None:
    """The same table gives the same bytes."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(table)
    path.write_bytes(gzip.compress(text.getvalue().encode(), mtime=0))


def machine() -> dict[str, object]:
    """What rounding depends on."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    facts = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    present = facts.get("flags", "").split()
    return {
        "processor": facts.get("model name", "unknown"),
        "flags": [flag for flag in FLAGS if flag in present],
        "kernels": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


def record(folder: Path = FOLDER) -> dict[str, dict[str, object]]:
    """What is known of each part: ``code`` (commit), ``machine``."""
    path = folder / RECORD
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def parting(old: Table, new: Table, tolerance: float) -> str | None:
    """Where two tables part first, with both values, and how many lines differ; None where they agree."""
    before, now = by_key(old), by_key(new)
    apart = [key for key in before if key in now and not alike(before[key], now[key], tolerance)]
    gone = [key for key in before if key not in now]
    more = [key for key in now if key not in before]
    if not (apart or gone or more):
        return None
    counts = f"{len(apart)} of {len(before)} values differ, {len(gone)} are gone, {len(more)} are new"
    for key in before:
        if key in gone:
            return f"{counts}; the first: {', '.join(key)}: {before[key]} before, gone now"
        if key in apart:
            return f"{counts}; the first: {', '.join(key)}: {before[key]} before, {now[key]} now"
    return f"{counts}; the first: {', '.join(more[0])}: {now[more[0]]}"


def by_key(table: Table) -> dict[tuple[str, ...], str]:
    """A table's values by what they are of, in its order, without ``STATISTICS``."""
    values = {row[:-1]: row[-1] for row in table[1:]}
    if len(values) != len(table) - 1:
        raise ValueError("two lines of a table are of the same")
    return {key: value for key, value in values.items() if not is_statistic(key)}


def is_statistic(key: tuple[str, ...]) -> bool:
    """Whether it is of a table of the evaluation, in one of these columns."""
    return key[0].startswith("tables/") and key[-1].rpartition(" ")[2] in STATISTICS


def alike(first: str, second: str, tolerance: float) -> bool:
    """Whether two texts are equal, or are numbers, at least one with a fraction, that are close."""
    if first == second:
        return True
    one, other = as_number(first), as_number(second)
    if one is None or other is None or (first.lstrip("-").isdigit() and second.lstrip("-").isdigit()):
        return False
    return bool(abs(one - other) <= tolerance * max(1.0, abs(one)))


def as_number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
