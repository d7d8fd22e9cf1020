"""Spec A6: the view of a run out of its logs, finished or not."""

import io
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from hypogoal.cli import main
from hypogoal.core.artefacts import create_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.progress import MetricsLog
from hypogoal.live_view import BARS, Boards, curve, finished, mirror, read_progress, view


def write(folder, rows):
    log = MetricsLog(folder / "metrics.jsonl")
    for row in rows:
        log.write(**row)


@pytest.fixture
def run(tmp_path):
    """A complete ensemble and an agent whose artefact is still being made, its last line half written."""
    run = tmp_path / "run"
    with create_artefact(run / "ensemble", kind="ensemble", config={}, seed=0) as folder:
        goals = ("collect-red-key", "open-red-door")
        write(folder, [{"sub_goal": goal, "step": s, "loss": 1 / s} for goal in goals for s in (10, 20)])
    with create_artefact(run / "meta/layout-100-seed-0", kind="meta", config={}, seed=0) as folder:
        write(folder, [{"step": 1_000 * s, "success": s / 10, "length": 50.0} for s in range(1, 10)])
        with (folder / "metrics.jsonl").open("a") as file:
            file.write('{"step": 10000, "succ')
        yield run


def test_what_is_being_made_comes_first(run):
    """Spec A6: read from the folder that a stage fills, under the name that it will have."""
    agent, ensemble = read_progress(run)
    assert (agent.name, agent.step, agent.watched) == ("meta/layout-100-seed-0", 9_000, "success")
    assert agent.series == tuple(s / 10 for s in range(1, 10))
    assert agent.seconds is not None and agent.seconds < 60
    assert (ensemble.title, ensemble.seconds) == ("ensemble: open-red-door", None)
    assert ensemble.series == (0.1, 0.05)


@pytest.mark.parametrize("boards", [False, True])
def test_a_damaged_log_is_read_as_far_as_it_goes(tmp_path, boards):
    """Spec A6, G2: steps that are none, numbers that cannot be drawn, names that lead out of the folder."""
    lines = [{"step": step, "loss": 2.0} for step in ("x", None, float("nan"), 1e999, True, -1, 10**400)]
    lines += [{"step": 1, "loss": 2.0, "sub_goal": name} for name in ("../../out", 3, ["a"])]
    lines += [{"step": 2, "loss": loss} for loss in (float("inf"), float("nan"), 10**400, 1e308, "x", None, [1], True)]
    lines += [{"step": 3, "loss": 1.5}, {"step": 4, "loss": 0.5}]
    texts = [json.dumps(line) for line in lines]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").write_text("\n".join(["[" * 100_000, "3", *texts]))
    rows = read_progress(tmp_path / "run")
    assert [(row.step, row.series) for row in rows] == [(4, (1.5, 0.5))]
    assert view(rows).row_count == 1
    if boards:
        pytest.importorskip("tensorboard")
        mirror(rows, Boards(tmp_path / "boards"))
        assert {path.name for path in tmp_path.iterdir()} == {"run", "boards"}


def test_the_view_fits_80_columns(run):
    """Spec A6: with ages, steps, the last value and a curve; long names lose their beginning."""
    log = next(run.glob("meta/.*/files/metrics.jsonl"))
    os.utime(log, (time.time() - 300, time.time() - 300))
    deep = run / "a-setting-with-a-long-name" / "options" / "layout-123-seed-45"
    with create_artefact(deep, kind="options", config={}, seed=0) as folder:
        write(folder, [{"step": 1_500_000, "reached": 0.987654321}])
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(view(read_progress(run)))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    assert "1 in the making, 2 complete" in lines[0]
    text = "\n".join(lines)
    assert "5 min ago" in text and "1,500,000" in text and "reached 0.988" in text
    assert "options/layout-123-seed-45" in text
    assert "▂▃▃▄▅▅▆▇▇" in text or "▂▂▃▄▅▅▆▇▇" in text
    assert sum(line.startswith("…") for line in lines) == 1


def test_a_view_of_few_rows_says_that_there_are_more(run):
    """Spec A6: what does not fit the terminal is counted."""
    table = view(read_progress(run) * 10, most=5)
    assert table.row_count == 4
    assert table.caption == "and 16 more"


def test_curves_by_hand():
    """Spec A6: shares from 0 to 1, anything else from its least to its greatest; a constant is flat."""
    assert curve([0, 0.5, 1], (0, 1)) == BARS[0] + BARS[4] + BARS[7]
    assert curve([10, 20]) == BARS[0] + BARS[7]
    assert curve([3, 3, 3]) == BARS[0] * 3
    assert curve([float("nan")]) == ""
    assert curve([1, 1, 3, 3], width=2) == BARS[0] + BARS[7]


def test_curves_of_what_cannot_be_drawn():
    """Spec G2: what is no number is left out."""
    assert curve([float("inf"), 1.0, float("nan"), 2.0, 1e308]) == curve([1.0, 2.0])


def test_watch_from_the_command_line(run, capsys, tmp_path):
    """Spec A6, G2: without a terminal it prints once; nothing to watch is one line."""
    assert main(["watch", str(run), "--once"]) == 0
    assert "meta/layout-100-seed-0" in capsys.readouterr().out
    assert main(["watch", str(run)]) == 0
    capsys.readouterr()
    assert main(["watch", str(tmp_path / "nowhere")]) == 2
    assert "no such run" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"no metrics\.jsonl"):
        read_progress(tmp_path / "empty")


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "utf-8"])
def test_a_pipe_may_take_fewer_signs(run, encoding):
    """Spec A6: what an encoding does not have, the curve's blocks among it, is a question mark and no error."""
    command = [sys.executable, "-m", "hypogoal", "watch", str(run), "--once"]
    environment = os.environ | {"PYTHONUTF8": "0", "PYTHONIOENCODING": encoding}
    done = subprocess.run(command, env=environment, capture_output=True, check=False, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    told = done.stdout.decode(encoding)
    assert "complete" in told and ("█" in told) == (encoding == "utf-8") and "Error" not in done.stderr.decode(encoding)


def test_a_run_is_finished_when_it_says_so(tmp_path):
    """Spec A6: run.json is written last; while something is made anew it is not finished."""
    with create_artefact(tmp_path / "meta", kind="meta", config={}, seed=0) as folder:
        write(folder, [{"step": 1, "success": 0.5}])
        (tmp_path / "run.json").write_text(json.dumps({}))
        assert not finished(tmp_path)
    assert finished(tmp_path)


def events(folder):
    """(step, tag, value) of all event files in a folder."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    found = []
    for path in sorted(folder.glob("events.*")):
        for event in EventFileLoader(str(path)).Load():
            found += [(event.step, value.tag, value.tensor.float_val[0]) for value in event.summary.value]
    return found


def test_tensorboard_reads_the_logs(run, tmp_path, capsys):
    """Spec A6: every number of every log, an ensemble's by sub-goal, also while an agent is still learning."""
    out = tmp_path / "boards"
    assert main(["watch", str(run), "--once", "--tensorboard", str(out)]) == 0
    agent = events(out / "meta/layout-100-seed-0")
    assert [row for row in agent if row[1] == "success"] == [
        (1_000 * s, "success", pytest.approx(s / 10)) for s in range(1, 10)
    ]
    assert {tag for _, tag, _ in agent} == {"success", "length"}
    assert events(out / "ensemble/open-red-door") == [
        (10, "loss", pytest.approx(0.1)),
        (20, "loss", pytest.approx(0.05)),
    ]
    assert main(["watch", str(run), "--once", "--tensorboard", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_tensorboard_gets_what_is_new_once(run, tmp_path):
    """Spec A6: looking again writes only the lines that came since, a resumed stage's old ones not again."""
    boards = Boards(tmp_path / "boards")
    mirror(read_progress(run), boards)
    log = next(run.glob("meta/.*/files/metrics.jsonl"))
    kept = log.read_text().splitlines()[:5]
    log.write_text("\n".join([*kept, '{"step": 6000, "success": 0.6}', '{"step": 10000, "success": 1.0}']) + "\n")
    mirror(read_progress(run), boards)
    found = [step for step, tag, _ in events(tmp_path / "boards/meta/layout-100-seed-0") if tag == "success"]
    assert found == [1_000 * s for s in range(1, 11)]


@pytest.mark.parametrize("name", ["...partial", "....partial"])
def test_boards_stay_in_their_folder(tmp_path, name):
    """Spec G2: the name of a draft is a stranger's: it may not climb."""
    (tmp_path / "run" / name / "files").mkdir(parents=True)
    (tmp_path / "run" / name / "files" / "metrics.jsonl").write_text('{"step": 1, "loss": 1}\n')
    assert main(["watch", str(tmp_path / "run"), "--once", "--tensorboard", str(tmp_path / "boards")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["boards", "run"]
    assert sum(len(events(folder)) for folder in [tmp_path / "boards", *(tmp_path / "boards").rglob("*/")]) == 1


def test_boards_of_whatever_is_in_a_log(tmp_path, capsys):
    """Spec G2: names and keys that are no UTF-8, thousands of sub-goals; nothing is kept open for them."""
    odd = tmp_path / "run" / "\udcff\udcfe"
    odd.mkdir(parents=True)
    (odd / "metrics.jsonl").write_text('{"step": 1, "\\ud800": 2}\n')
    many = "".join(f'{{"step": 1, "loss": 1, "sub_goal": "g{number}"}}\n' for number in range(2000))
    (tmp_path / "run" / "metrics.jsonl").write_text(many)
    open_files, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    boards = Boards(tmp_path / "boards")
    mirror(read_progress(tmp_path / "run"), boards)
    assert len(os.listdir("/proc/self/fd")) <= open_files + 1 and threading.active_count() == threads
    assert events(tmp_path / "boards" / "??") == [(1, "?", 2.0)]
    assert sum(len(events(folder)) for folder in (tmp_path / "boards").rglob("g*")) == 2000


def test_boards_that_are_a_link_into_nothing(tmp_path, run, capsys):
    """Spec G2: the folder would be made where the link leads."""
    (tmp_path / "boards").symlink_to(tmp_path / "nothing")
    assert main(["watch", str(run), "--once", "--tensorboard", str(tmp_path / "boards")]) == 2
    assert "exists already" in capsys.readouterr().err and not (tmp_path / "nothing").exists()


def test_without_the_extra(run, tmp_path, monkeypatch, capsys):
    """Spec A6: one line that says what to install, and no folder."""
    monkeypatch.setitem(sys.modules, "tensorboard.summary.writer.record_writer", None)
    assert main(["watch", str(run), "--tensorboard", str(tmp_path / "boards")]) == 2
    assert "pip install 'hypogoal[tensorboard]'" in capsys.readouterr().err
    assert not (tmp_path / "boards").exists()
