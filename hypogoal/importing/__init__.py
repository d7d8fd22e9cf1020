"""Import of what users have: arrays, pictures, recorded episodes, tables of labels."""
