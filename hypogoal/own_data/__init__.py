"""States that users bring: NumPy arrays, folders of images, Minari datasets; and out again (Spec B6)."""

from hypogoal.own_data.arrays import read_arrays, write_arrays
from hypogoal.own_data.images import read_images
from hypogoal.own_data.marking import KINDS, Marks, Played, Recorded, Source, mark_states, recorded_states
from hypogoal.own_data.minari import MAIN_FILE, read_minari, write_minari
from hypogoal.own_data.parts import Parts, collected_of

__all__ = [
    "KINDS", "MAIN_FILE", "Marks", "Parts", "Played", "Recorded", "Source", "collected_of", "mark_states",
    "read_arrays", "read_images", "read_minari", "recorded_states", "write_arrays", "write_minari",
]  # fmt: skip
