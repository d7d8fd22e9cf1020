"""Rooms: hypothesis learning with a known answer, since the features of its scenes are planted."""
