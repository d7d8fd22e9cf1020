"""Import of what users have: arrays, pictures, recorded episodes, tables of labels (Spec B6, I6)."""
