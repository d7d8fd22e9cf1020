"""The toy sweep and the helpers beside the tests are found from here."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]


@pytest.fixture
def forked_cells() -> Iterator[None]:
    """Cells of this test are forked: what they do is its point, not how a Python starts."""
    from forked import forked

    with forked():
        yield
