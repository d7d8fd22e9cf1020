"""States that users bring: NumPy arrays, folders of images, Minari datasets; and out again (Spec B6)."""

from hypogoal.own_data.arrays import read_arrays, write_arrays
from hypogoal.own_data.images import read_images
from hypogoal.own_data.minari import MAIN_FILE, read_minari
from hypogoal.own_data.parts import Parts, collected_of

__all__ = ["MAIN_FILE", "Parts", "collected_of", "read_arrays", "read_images", "read_minari", "write_arrays"]
