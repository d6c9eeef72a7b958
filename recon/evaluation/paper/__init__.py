"""The experiments of the seed paper, repeated and corrected."""
