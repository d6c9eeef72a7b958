"""The map on disk: one file of records, and what a session keeps in it."""
