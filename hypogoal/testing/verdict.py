"""The result of a check, and how checks run: a failure ends the checks that build on it, not the program."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode
from hypogoal.core.terminal import printable
from hypogoal.data import Unmet

Test = tuple[str, Callable[[], str]]


def promise(kept: bool, fault: str, do: str) -> None:
    """Raise a ``UserError``, with what is wrong and what to do about it, unless a promise is ``kept``."""
    if not kept:
        raise UserError(fault, do=do)


@dataclass(frozen=True)
class Verdict:
    """The result of one check.

    Attributes:
        name: what was checked.
        ok: whether the promise is kept.
        text: the finding; if the promise is broken, also what to do.
        warnings: findings that are allowed but may surprise.
    """

    name: str
    ok: bool
    text: str
    warnings: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """As ``hypogoal check`` prints it."""
        first = f"{'ok  ' if self.ok else 'FAIL'} {self.name}: {self.text}"
        return [printable(line) for line in (first, *(f"warn {self.name}: {text}" for text in self.warnings))]


def run(tests: Iterable[Test]) -> Iterator[Verdict]:
    """Run tests, pairs of a name and a function, until one fails: later ones build on earlier ones.

    A function returns its finding, or raises. Its warnings are kept. If play did not reach the states that later tests
    need, the rest is skipped, which is no failure.
    """
    tests = iter(tests)
    for name, test in tests:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            ok, over = True, False
            try:
                with UsersCode("what is checked"):
                    text = test()
            except Unmet as error:
                text, over = "not looked at to the end", True
                warnings.warn(str(error), stacklevel=1)
                if rest := [later for later, _ in tests]:
                    warnings.warn(f"not looked at: {', '.join(rest)}", stacklevel=1)
            except UserError as error:
                ok, text = False, str(error)
        yield Verdict(
            name, ok, " ".join(text.split()), tuple(dict.fromkeys(str(warning.message) for warning in caught))
        )
        if over or not ok:
            return


def require(verdicts: Iterable[Verdict]) -> None:
    """For a test suite: raise an ``AssertionError`` that names the first broken promise, if any."""
    for verdict in verdicts:
        if not verdict.ok:
            raise AssertionError("\n".join(verdict.lines))
