"""The command as tests call it, in their own process."""

from __future__ import annotations

import pytest

from pincal.cli import main


def run(*arguments: object) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)
