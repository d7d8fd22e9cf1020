"""What ``python -m hypogoal`` and the command ``hypogoal`` run."""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # During imports Ctrl-C ends the process, because Python's own handler would print a page of traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from hypogoal.cli import main

if __name__ == "__main__":
    sys.exit(main())
