"""Hypotheses: what a sub-goal may depend on. Member networks, ensembles, and their training."""
