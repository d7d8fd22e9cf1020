"""The attack kit: kills, limits, hostile and fuzzed files, own code that fails; its long runs are docs/faults.md."""
