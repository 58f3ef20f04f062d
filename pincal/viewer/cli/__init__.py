"""The verb ``pincal view``."""
