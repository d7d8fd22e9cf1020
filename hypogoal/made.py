"""What a stage made, as an object of a program or a notebook."""

from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

from hypogoal.core.terminal import say
from hypogoal.look import describe, lines, outcome


class Made:
    """A data file, an artefact or a run at ``path``. It works wherever a path is expected, and shows what it holds."""

    def __init__(self, path: str | PathLike[str]):
        self.path = Path(path)

    def __fspath__(self) -> str:
        return str(self.path)

    @property
    def metrics(self) -> Any:
        """Its numbers: counts of states or a training's last log entry, a dict; of an evaluation the DataFrame."""
        table = self.path / "numbers.csv"
        if table.is_file():
            from hypogoal.evaluation.house import read_numbers

            return read_numbers(table)
        return dict(describe(self.path).get("numbers", {}))

    def __repr__(self) -> str:
        details = describe(self.path)
        return "\n".join([lines(details)[0], *outcome(details)])

    def _repr_html_(self) -> str:
        return f'<pre style="line-height: 1.2">{escape(repr(self))}</pre>'

    def show(self) -> None:
        """Print what ``hypogoal show`` prints: result, configuration, inputs."""
        for line in [*repr(self).splitlines(), *lines(describe(self.path))[1:]]:
            say(line)
