"""Pure functions of space: rigid motions, projection, triangulation and its error."""
