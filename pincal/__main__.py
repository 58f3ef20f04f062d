"""``python -m pincal`` is the command."""

from pincal.cli import entry

entry()
