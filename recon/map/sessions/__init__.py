"""Several drives in one map: copied into it, linked, placed, and taken out again."""
