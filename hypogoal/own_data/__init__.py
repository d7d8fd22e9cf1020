"""States that users bring: NumPy arrays, folders of images, Minari datasets; and out again (Spec B6)."""
