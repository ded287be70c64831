"""The command line: a user of the library."""
