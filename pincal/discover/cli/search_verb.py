"""``pincal discover``: from a URDF and tables to the effects that a model lacks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import click

from pincal.cli.arguments import option, verb
from pincal.cli.fitting import FIT_EXITS, FIT_FILES, FIT_SHOWN, FitArguments, run_fit, workers
from pincal.errors import Exit

_DISCOVER_EXAMPLES = f"""
Examples:
  pincal discover tracker.csv            # with a cell.toml beside it, which pincal check writes
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm
  pincal discover robot.urdf tracker.csv --out results --try gear_ripple:joint_2:order=101
  pincal discover robot.urdf monday.csv tuesday.csv --split station --out results
  pincal discover robot.urdf tracker.csv --out results --dask tcp://10.0.0.5:8786

{FIT_FILES},
all for the model with the effects that were found, and discovery.json.
"""


@dataclass(frozen=True, kw_only=True)
class DiscoverArguments(FitArguments):
    """Arguments of discover."""

    tried: tuple[str, ...] = option(
        "Also try this effect, named as for --add: for a gear of known ratio or an "
        "encoder of known line count the cycles "
        "per revolution, e.g. gear_ripple:joint_2:order=101. An effect of known order is "
        "detected at a smaller amplitude "
        "than one that is searched for.",
        (),
        metavar="EFFECT",
        name="--try",
    )
    stability: int = option(
        "Number of subsamples of half of the poses on which the search is repeated, to "
        "count how often each effect "
        "is found; 0 for none.",
        20,
        type=click.IntRange(min=0),
        metavar="N",
    )
    remainder: bool = option(
        "After the last name also fit what is smooth in the joints and has no name, if regions "
        "that are left out are predicted better with it, and none of them worse than by geometry "
        "and elasticity. It predicts, and says nothing of causes.",
        True,
        name="--remainder/--no-remainder",
    )


@verb(
    DiscoverArguments,
    examples=_DISCOVER_EXAMPLES,
    exits=FIT_EXITS,
    shown=(*FIT_SHOWN, "tried", "stability"),
    defaults={"model": "geometric"},
)
def discover(arguments: DiscoverArguments) -> Exit:
    """Identify the effects that the model lacks.

    Reports where model and data disagree, which effects explain it, and how the error at unfitted
    poses shrinks.
    """
    from pincal.cli.inputs import named_effects
    from pincal.discover.cli.search_output import SearchOutput
    from pincal.discover.run import run_discovery

    repeats = arguments.stability > 0 or arguments.split.split == "station"
    with workers(arguments.dask, repeats=repeats) as executor:

        def run(robot: Any, tables: Any, options: Any, **choice: Any) -> SearchOutput:
            extra = named_effects(arguments.tried, options, robot=robot, tables=tables)
            choice |= {"extra": extra, "stability": arguments.stability, "executor": executor}
            choice |= {"remainder": arguments.remainder}
            return SearchOutput.of(run_discovery(robot, tables, options, **choice))

        return run_fit(arguments, run)
