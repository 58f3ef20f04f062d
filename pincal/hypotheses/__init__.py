"""What may be wrong with a table, or may have changed, and how one such supposition is believed."""
