"""The verbs of ``pincal fleet``."""
