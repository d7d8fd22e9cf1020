"""Numbers and pictures: pure functions on arrays; figures are apart from numbers, files are the stages'."""
