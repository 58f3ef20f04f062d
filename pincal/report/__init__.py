"""Rendering: one page for a reader who does not know the model, its figures, tables and words."""
