"""The stages, one file each, and what those with options share (``agents.py``)."""
