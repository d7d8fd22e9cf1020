"""``python -m hypogoal``."""

import sys

from hypogoal.cli import main

sys.exit(main())
