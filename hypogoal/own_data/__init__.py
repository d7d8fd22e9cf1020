"""Import of users' states (NumPy arrays, folders of images, Minari datasets), and export (Spec B6)."""
