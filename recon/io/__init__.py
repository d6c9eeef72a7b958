"""Readers and writers of file formats; foreign conventions are converted here and nowhere else."""
