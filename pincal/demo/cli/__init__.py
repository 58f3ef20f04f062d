"""The verb ``pincal demo``."""
