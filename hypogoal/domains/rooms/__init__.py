"""Rooms, a domain in which the right hypothesis is known, because the features of its scenes are planted."""
