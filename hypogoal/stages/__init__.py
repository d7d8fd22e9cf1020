"""The stages, one file each, and in ``agents.py`` what the stages with options share."""
