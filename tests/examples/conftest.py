"""The modules in examples/ are found, and the names of their parts are trusted."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
