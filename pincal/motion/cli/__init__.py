"""Arms in motion on the command line."""
