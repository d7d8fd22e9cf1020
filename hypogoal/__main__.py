"""What ``python -m hypogoal`` and the command ``hypogoal`` run."""

import gc
import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # During imports Ctrl-C ends the process, because Python's own handler would print a page of traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
if gc.isenabled():
    # Python looks for garbage each time 700 more objects were made, and imports make many, none of them garbage. With
    # this number a command takes a tenth less time to start.
    gc.set_threshold(100_000)

from hypogoal.cli import main

if __name__ == "__main__":
    sys.exit(main())
