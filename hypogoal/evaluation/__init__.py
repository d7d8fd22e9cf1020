"""Numbers and figures of a run. Numbers are apart from figures; the stages write the files."""
