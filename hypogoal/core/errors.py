"""Errors for users: one line that says what is wrong, where and what to do."""

from typing import Any


class UserError(Exception):
    """A mistake that the user can fix. The command line prints it as one line and exits with code 2.

    Args:
        what: what is wrong, as a sentence without a full stop.
        where: the file, key or value that is wrong.
        do: what to do next.
    """

    def __init__(self, what: str, where: object = None, do: str = ""):
        self.what, self.where, self.do = what, where, do
        line = what
        if where is not None:
            line += f": {where}"
        if do:
            line += f". {do}"
        super().__init__(printable(line))


class Complete(Exception):
    """No error: the output to resume is complete and as requested. The command line says so and exits with code 0."""


class NumericalError(Exception):
    """NaN or Inf in training: names the member and the step; nothing was overwritten."""


def printable(text: str) -> str:
    """A text as one line without control, invisible and bidirectional characters, which are shown as ``?``."""
    line = " ".join(text.split())
    signs = [sign if sign.isprintable() else "?" for sign in line]
    return "".join(signs)


def reason(error: Any) -> str:
    """What is wrong, in one line; of a pydantic ``ValidationError`` the first fault and its place."""
    if not hasattr(error, "errors"):
        return str(error)
    fault = error.errors()[0]
    place = ".".join(map(str, fault["loc"]))
    return f"{place}: {fault['msg']}"
