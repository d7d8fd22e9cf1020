"""``python -m hypogoal``, and what the command ``hypogoal`` runs."""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Until there is something to stop, Ctrl-C ends the process: what is half imported would be a page of traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from hypogoal.cli import main

if __name__ == "__main__":
    sys.exit(main())
