"""``pincal discover``: where model and data disagree, and what makes it."""

from __future__ import annotations

from functools import partial

from pincal.cli.arguments import verb
from pincal.cli.fitting import EXITS, FILES, FitArguments, run_fit, side_by_side
from pincal.errors import Exit

_EXAMPLES = f"""
Examples:
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm
  pincal discover robot.urdf monday.csv tuesday.csv --split station --out results

{FILES},
all for the model with the effects that were found, and discovery.json.
"""
_DEFAULTS = {
    "model": "geometric",
    "test_fraction": 0.2,
    "split": "blocked",
}


@verb(FitArguments, examples=_EXAMPLES, exits=EXITS, defaults=_DEFAULTS)
def discover(arguments: FitArguments) -> Exit:
    """Identify the effects that the model misses.

    Reports where model and data disagree, which effects explain it, and how the error on held-out rows shrinks.
    """
    from pincal.discover.run import run_discovery

    with side_by_side(arguments) as executor:
        return run_fit(arguments, partial(run_discovery, executor=executor))
