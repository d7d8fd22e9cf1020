"""What lies in the current folder, in the home folder or in the environment changes nothing (Spec G2)."""

import json
import os
import subprocess
import sys
from pathlib import Path

LOADED = """
import json, os, subprocess, sys
from hypogoal.core.surroundings import shield
shield()
import matplotlib.pyplot, matplotlib.style, cv2
own, settings = matplotlib.rcParamsDefault, matplotlib.rcParams
odd = [name for name, value in settings.items() if name != "backend" and value != own[name]]
child = subprocess.run([sys.executable, "-P", "-c", "print(1)"], capture_output=True, text=True)
library = "mine" in matplotlib.style.available
print(json.dumps([odd, settings["backend"], library, os.getcwd(), child.stdout, child.stderr]))
"""


def stuff(folder: Path) -> dict[str, str]:
    """Fill a folder with what libraries would read, and never finish reading; the environment that leads there."""
    styles = folder / ".config" / "matplotlib" / "stylelib"
    styles.mkdir(parents=True)
    os.mkfifo(folder / "matplotlibrc")
    os.mkfifo(styles / "mine.mplstyle")
    (styles.parent / "matplotlibrc").write_text("figure.dpi: 7\n")
    (folder / "libm.so.6").write_text("no library")
    places = {"MATPLOTLIBRC": str(folder), "MPLCONFIGDIR": str(styles.parent), "MPLBACKEND": "nonsense"}
    return {**os.environ, **places, "HOME": str(folder)}


def test_libraries_load_as_if_nothing_were_around(tmp_path: Path) -> None:
    """Spec G2: settings and styles of matplotlib that are pipes, its backend none, a library beside a child process."""
    environment = stuff(tmp_path)
    command = [sys.executable, "-P", "-c", LOADED]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [[], "agg", False, str(tmp_path), "1\n", ""]
