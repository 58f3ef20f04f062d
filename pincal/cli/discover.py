"""``pincal discover``: where model and data disagree, and what makes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import click

from pincal.cli.arguments import option, verb
from pincal.cli.fitting import EXITS, FILES, FitArguments, run_fit
from pincal.cli.workers import workers
from pincal.errors import Exit

_EXAMPLES = f"""
Examples:
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm
  pincal discover robot.urdf tracker.csv --out results --try gear_ripple:joint_2:order=101
  pincal discover robot.urdf monday.csv tuesday.csv --split station --out results
  pincal discover robot.urdf tracker.csv --out results --dask tcp://10.0.0.5:8786

{FILES},
all for the model with the effects that were found, and discovery.json.
"""
_DEFAULTS = {
    "model": "geometric",
    "test_fraction": 0.2,
}


@dataclass(frozen=True, kw_only=True)
class DiscoverArguments(FitArguments):
    """Arguments of discover."""

    tried: tuple[str, ...] = option(
        "Also try this effect, named as for --add: of a gear whose ratio is known, or an encoder whose lines are, the waves "
        "a turn, e.g. gear_ripple:joint_2:order=101. A known order shows when it is smaller than one that is searched for.",
        (),
        metavar="EFFECT",
        name="--try",
    )
    stability: int = option(
        "Halves of the poses on which the search is repeated, to tell how often each name comes up; 0 for none.",
        20,
        type=click.IntRange(min=0),
        metavar="N",
    )


@verb(DiscoverArguments, examples=_EXAMPLES, exits=EXITS, defaults=_DEFAULTS)
def discover(arguments: DiscoverArguments) -> Exit:
    """Identify the effects that the model misses.

    Reports where model and data disagree, which effects explain it, and how the error on held-out rows shrinks.
    """
    from pincal.cli.inputs import named_effects
    from pincal.discover.run import run_discovery

    repeats = arguments.stability > 0 or arguments.split.split == "station"
    with workers(arguments.dask, repeats=repeats) as executor:

        def run(robot: Any, tables: Any, options: Any, **choice: Any) -> Any:
            extra = named_effects(arguments.tried, options, robot=robot, tables=tables)
            choice |= {"extra": extra, "stability": arguments.stability, "executor": executor}
            return run_discovery(robot, tables, options, **choice)

        return run_fit(arguments, run)
