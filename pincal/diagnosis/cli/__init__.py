"""The verbs ``pincal diagnose`` and ``pincal update``."""
