"""Discovery: where model and data disagree, which effect makes it, and what else it could be."""
