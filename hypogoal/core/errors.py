"""Errors that a user reads: one line saying what, where and what to do next (Spec G2, G3)."""

from hypogoal.core.terminal import printable


def one_line(text: str) -> str:
    """A text without its ends of lines; spaces within one stay, since a path may have them."""
    return " ".join(line.strip() for line in text.expandtabs(1).splitlines() if line.strip())


class UserError(Exception):
    """A mistake that the user can fix. The command line prints it as one line and exits with code 2.

    Args:
        what: what is wrong, as a sentence without a full stop.
        where: the file, key or value that is wrong.
        do: what to do next.
    """

    def __init__(self, what: str, where: object = None, do: str = ""):
        self.what, self.where, self.do = what, where, do
        line = what if where is None else f"{what}: {where}"
        super().__init__(printable(one_line(f"{line}. {do}" if do else line)))


class Killed(UserError):
    """A process of a stage was killed from outside, which no stage can catch."""


class Complete(UserError):
    """What is to be resumed is complete, made as asked: the command line says so and exits with code 0.

    ``path`` is what the command would have made, ``note`` what else there is to say about it.
    """

    def __init__(self, path: object, note: str = ""):
        super().__init__(f"{path} is complete already" + (f" ({note})" if note else ""))
        self.path, self.note = path, note


class NumericalError(Exception):
    """NaN or Inf where a number was needed (Spec G3): names the member and the step; nothing was overwritten."""
