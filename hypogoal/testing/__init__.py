"""The contracts of domains, diversity objectives and networks, as tests that users run on theirs (Spec B6, C1).

``hypogoal check`` prints a line for each test. In your own test suite: ``require(check_domain(DOMAIN))``.
"""

from hypogoal.testing.domains import check_domain
from hypogoal.testing.networks import check_network
from hypogoal.testing.objectives import check_objective
from hypogoal.testing.verdict import Verdict, require

__all__ = ["Verdict", "check_domain", "check_network", "check_objective", "require"]
