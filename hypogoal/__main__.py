"""``python -m hypogoal``, and what the command ``hypogoal`` runs."""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # During imports Ctrl-C just ends the process; a handler would print a page of traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from hypogoal.cli import main

if __name__ == "__main__":
    sys.exit(main())
