"""Errors for users: each is one line that says what is wrong, where it is wrong, and what to do."""

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


class NotInstalled(UserError):
    """A name that nothing built in and no installed package has."""


class Complete(Exception):
    """A signal that the output to resume is complete and as requested, which is no error.

    The command line prints the message and exits with code 0.
    """


class NumericalError(Exception):
    """NaN or Inf in training. The message names the member and the step, and nothing was overwritten."""


def printable(text: str) -> str:
    """Return a text as one line. Control, invisible and bidirectional characters are shown as ``?``."""
    line = " ".join(text.split())
    signs = [sign if sign.isprintable() else "?" for sign in line]
    return "".join(signs)


def reason(error: Any) -> str:
    """Return what is wrong, in one line. For a pydantic ``ValidationError``, that is the first fault and its place."""
    if not hasattr(error, "errors"):
        return str(error)
    fault = error.errors()[0]
    place = ".".join(map(str, fault["loc"]))
    return f"{place}: {fault['msg']}"
