"""The command line: parse, build the configuration, call one pipeline function, print one table."""
