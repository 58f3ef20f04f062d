"""The verb ``pincal design``."""
