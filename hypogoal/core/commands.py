"""Printed commands: they can be pasted into a shell and work.

Words are quoted. ``HYPOGOAL_TRUST`` is put in front for the user code that was allowed in this process, even if it is
set now, since it may be set for this command only. Code that was not allowed, perhaps a stranger's, is left out: the
command refuses it, and says how to allow it.
"""

import re
import shlex

from hypogoal.core.own_code import allowed_before, permission

OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")  # module:object


def command(*words: object) -> str:
    """The command ``hypogoal *words`` as one would type it next."""
    line = shlex.join(["hypogoal", *map(str, words)])
    names = sorted(name for name in allowed_before() - {*map(str, words)} if OWN.fullmatch(name))
    return f"{permission(names)} {line}" if names else line


def advice(lead: str, *words: object) -> str:
    """``lead`` and the command that an error advises: 'First run: hypogoal evaluate runs/mine'."""
    return f"{lead}: {command(*words)}"
