"""Readers of files that are no plain tables: nested values, recordings, data sets."""
