"""Hypotheses: what a sub-goal may depend on. Member networks, ensembles of them, and their training (Spec C)."""
