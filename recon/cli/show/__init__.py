"""What a command shows beside its files: its source, warnings, progress and results."""
