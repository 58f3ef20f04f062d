"""The verb ``pincal discover``."""
