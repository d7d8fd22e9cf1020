"""The import of users' arrays, pictures, recorded episodes and tables of labels."""
