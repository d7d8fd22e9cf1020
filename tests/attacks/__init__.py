"""The attack kit: kills and damaged files; docs/errors.md has what came of its long runs."""
