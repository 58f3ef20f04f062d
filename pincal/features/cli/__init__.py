"""The verb ``pincal measure``."""
