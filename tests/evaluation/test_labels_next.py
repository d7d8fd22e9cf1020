"""The measures of the study of which states to label next, on cases whose true value is forced."""

import numpy as np

from studies.labels_next import Course, ends, labels_needed


def test_a_policy_ends_at_the_nearest_positive_prediction() -> None:
    """Of equally near states each counts its share; a positive behind the nearest says nothing."""
    steps, labels = np.array([0, 1, 1, 2, 3]), np.array([False, False, True, True, False])
    course = Course(np.zeros((5, 1, 1, 3), np.uint8), steps, labels)
    for positives, expected in (
        ([3], (0.0, 1.0)),  # the truth alone
        ([0, 3], (1.0, 0.0)),  # a false positive where it begins
        ([1, 2, 4], (0.5, 0.5)),
        ([3, 4], (0.0, 1.0)),  # the false positive is farther
        ([], (0.0, 0.0)),
    ):
        assert ends(np.isin(np.arange(5), positives), course) == expected


def test_labels_suffice_only_where_all_later_ones_do() -> None:
    good, fooled, blind = (0.02, 0.95), (0.03, 0.97), (0.0, 0.5)
    assert labels_needed({0: good, 10: good, 20: good}) == 0
    assert labels_needed({0: good, 10: fooled, 20: good}) == 20
    assert labels_needed({0: good, 10: good, 20: blind}) == 40, "never positive is not good enough"
