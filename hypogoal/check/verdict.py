"""What a check finds: a verdict on each law, up to the first that is broken, since later ones build on it."""

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import message

COLOUR = re.compile(r"\x1b\[[\d;]*m")  # of a terminal's text, as Gymnasium's warnings have


@dataclass(frozen=True)
class Verdict:
    """Whether a law is kept.

    Attributes:
        name: of the law.
        ok: whether it is kept.
        text: what was seen; of a broken law what is wrong, where, and what to do.
        warnings: what is allowed but may surprise.
    """

    name: str
    ok: bool
    text: str
    warnings: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """As ``hypogoal check`` prints it."""
        verdict = f"{'ok  ' if self.ok else 'FAIL'} {self.name}: {self.text}"
        return [verdict, *(f"warn {self.name}: {text}" for text in self.warnings)]


def promise(kept: object, fault: str, do: str) -> None:
    """Raise a ``UserError`` unless a promise is ``kept``."""
    if not kept:
        raise UserError(fault, do=do)


def verdicts(laws: Iterable[Callable[[Any], str | None]], subject: Any) -> Iterator[Verdict]:
    """The verdict on each law, a function of what is checked that raises what is wrong.

    It may return what it saw; else what its docstring says is so.
    """
    for law in laws:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                ok, text = True, law(subject) or str(law.__doc__)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever the checked code raises
                ok, (text, _) = False, message(error)
        texts = dict.fromkeys(COLOUR.sub("", str(warning.message)) for warning in caught)
        yield Verdict(law.__name__.replace("_", " "), ok, text, tuple(texts))
        if not ok:
            return


def require(results: Iterable[Verdict]) -> None:
    """For a test suite: raise an ``AssertionError`` that says which law is broken, if one is."""
    for verdict in results:
        assert verdict.ok, "\n".join(verdict.lines)
