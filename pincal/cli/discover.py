"""``pincal discover``: where model and data disagree, and what makes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pincal.cli.arguments import verb
from pincal.cli.fitting import EXITS, FILES, FitArguments, Outcome, run_fit
from pincal.errors import Exit

if TYPE_CHECKING:
    from rich.console import Console

    from pincal.cli.inputs import Prepared
    from pincal.measure.measurements import Measurements

_EXAMPLES = f"""
Example:
  pincal discover robot.urdf tracker.csv --out results --noise 0.05mm

{FILES},
all for the model with the effects that were found, and discovery.json.
"""


@verb(
    FitArguments,
    examples=_EXAMPLES,
    exits=EXITS,
    defaults={
        "model": ("geometric", None),
        "moment_frame": (None, "the one that fits best"),
        "test_fraction": (0.2, None),
        "split": ("blocked", None),
    },
)
def discover(arguments: FitArguments) -> Exit:
    """Find where model and data disagree, identify the missing effects, and validate them on held-out rows."""

    def pipeline(prepared: Prepared, holdout: Measurements | None) -> Outcome:
        from pincal.cli.tables import print_discovery, print_notes
        from pincal.discover.run import run_discovery
        from pincal.model.chain import MOMENT_FRAMES

        split = arguments.split
        found = run_discovery(
            prepared.robot,
            prepared.table,
            prepared.options,
            test_fraction=split.test_fraction,
            split=split.split,
            seed=split.seed,
            holdout=holdout,
            moment_frames=MOMENT_FRAMES if arguments.chosen.model.moment_frame is None else (),
        )

        def show(out: Console) -> None:
            print_discovery(found.report, out, found.gaps)
            print_notes(found.calibration.result.warnings, out)

        return Outcome(found.calibration, found.report, show, found)

    return run_fit(arguments, pipeline)
