"""Files of the field, read and written; every foreign convention ends here."""
