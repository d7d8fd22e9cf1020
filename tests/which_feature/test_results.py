"""The published tables are drawn from the committed cells (Spec F5)."""

from benchmarks.which_feature import CSV, tables


def test_tables_are_those_of_the_cells() -> None:
    """Every line of every table stands on the page, and the page has no other."""
    drawn = [line for line in tables(CSV) if line.startswith("|")]
    page = CSV.with_suffix(".md").read_text(encoding="utf-8")
    assert drawn == [line for line in page.splitlines() if line.startswith("|")]
