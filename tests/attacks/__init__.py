"""The attack kit: kills and damaged files; docs/faults.md has what came of its long runs."""
