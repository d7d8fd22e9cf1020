"""What audits say: of policies that exploit a classifier, and of recorded states."""
