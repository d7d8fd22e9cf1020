"""The contracts of domains, objectives, networks and other parts, as laws by which users check their own.

``hypogoal check`` prints a line for each law. In your own test suite, write ``require(check_domain(DOMAIN))``.
"""

from hypogoal.check.data import check_data
from hypogoal.check.domains import check_domain
from hypogoal.check.members import check_network, check_teacher, check_view
from hypogoal.check.objectives import check_objective
from hypogoal.check.parts import check_part
from hypogoal.check.verdict import Verdict, require

__all__ = [
    "Verdict",
    "check_data",
    "check_domain",
    "check_network",
    "check_objective",
    "check_part",
    "check_teacher",
    "check_view",
    "require",
]
