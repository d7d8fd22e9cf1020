"""What makes the pages and tables of docs/results; not installed with the package."""
