"""What a check finds: a verdict on each law, up to the first broken one, since later laws build on earlier ones."""

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import message

COLOUR = re.compile(r"\x1b\[[\d;]*m")  # colours of a terminal, which Gymnasium's warnings have


@dataclass(frozen=True)
class Verdict:
    """Whether a law is kept.

    Attributes:
        name: the name of the law.
        ok: whether the law is kept.
        text: what was seen. Of a broken law: what is wrong, where, and what to do.
        warnings: what is allowed but may surprise.
    """

    name: str
    ok: bool
    text: str
    warnings: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """The lines that ``hypogoal check`` prints."""
        verdict = f"{'ok  ' if self.ok else 'FAIL'} {self.name}: {self.text}"
        return [verdict, *(f"warn {self.name}: {text}" for text in self.warnings)]


def promise(kept: object, fault: str, do: str) -> None:
    """Raise ``UserError`` unless a promise is ``kept``."""
    if not kept:
        raise UserError(fault, do=do)


def verdicts(laws: Iterable[Callable[[Any], str | None]], subject: Any) -> Iterator[Verdict]:
    """Yield the verdict on each law, up to the first broken one.

    A law is a function of what is checked, and raises what is wrong. It may return what it saw. Otherwise, the text of
    the verdict is the law's docstring.
    """
    for law in laws:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                ok, text = True, law(subject) or str(law.__doc__)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - the checked code may raise anything
                ok, (text, _) = False, message(error)
        texts = dict.fromkeys(COLOUR.sub("", str(warning.message)) for warning in caught)
        yield Verdict(law.__name__.replace("_", " "), ok, text, tuple(texts))
        if not ok:
            return


def require(results: Iterable[Verdict]) -> None:
    """Raise ``AssertionError``, which says what law is broken, if there is one. This is for a test suite."""
    for verdict in results:
        assert verdict.ok, "\n".join(verdict.lines)
