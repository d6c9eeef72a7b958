"""One story per command of the program, as functions of the library."""
