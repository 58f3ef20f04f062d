"""The verb ``pincal simulate``."""
