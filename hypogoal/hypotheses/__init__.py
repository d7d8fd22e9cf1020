"""Hypotheses about what a sub-goal depends on: the member networks, the ensembles of members, and their training."""
