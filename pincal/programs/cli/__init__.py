"""Programs of controllers on the command line."""
