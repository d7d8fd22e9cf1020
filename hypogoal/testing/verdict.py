"""What one check found, and how checks are run: one that fails ends those that build on it, not the program."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from hypogoal.core.errors import UserError
from hypogoal.core.own_code import UsersCode
from hypogoal.core.terminal import printable
from hypogoal.dataset import Unmet

Test = tuple[str, Callable[[], str]]


class TimeUp(UserError):
    """A check took as long as it may: what is left is not looked at, and no promise is broken by that."""


def promise(kept: bool, what: str, do: str) -> None:
    """A ``UserError`` where a promise is not kept: what was found, and what to do about it."""
    if not kept:
        raise UserError(what, do=do)


@dataclass(frozen=True)
class Verdict:
    """One check.

    Attributes:
        name: what was checked.
        ok: whether the promise is kept.
        text: what was found; where the promise is not kept, also what to do.
        warnings: what is allowed and may still surprise.
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
    """Run tests, names and functions, one after the other, until one fails: those after it build on what it found.

    A function says what it found, or raises. Warnings that it gives are kept. Where time is up, or play did not meet
    what the next ones need, the rest is not looked at, which is no failure.
    """
    tests = iter(tests)
    for name, test in tests:
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            ok, over = True, False
            try:
                with UsersCode("what is checked"):
                    text = test()
            except (TimeUp, Unmet) as error:
                text, over = "not looked at to the end", True
                warnings.warn(str(error), stacklevel=1)
                if rest := [later for later, _ in tests]:
                    warnings.warn(f"not looked at: {', '.join(rest)}", stacklevel=1)
            except UserError as error:
                ok, text = False, str(error)
        yield Verdict(name, ok, " ".join(text.split()), tuple(dict.fromkeys(str(warning.message) for warning in given)))
        if over or not ok:
            return


def require(verdicts: Iterable[Verdict]) -> None:
    """For a test suite: passes if all promises are kept, else raises an ``AssertionError`` that says which is not."""
    for verdict in verdicts:
        if not verdict.ok:
            raise AssertionError("\n".join(verdict.lines))
