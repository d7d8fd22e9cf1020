"""What every stage needs and what knows nothing of the field: errors, settings, seeds, progress, artefacts."""
