"""The sensors of pincal, one to a file, each with everything that is special about it."""
