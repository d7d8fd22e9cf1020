"""What every stage needs, without any knowledge of the field: errors, settings, seeds, progress, artefacts."""
