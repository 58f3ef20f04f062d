"""The command line of acceptance tests."""
