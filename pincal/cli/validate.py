"""``pincal validate``: the accuracy of a calibrated model on new measurements."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from pincal.cli.arguments import argument, group, verb
from pincal.cli.common import GeneralOptions, ignore_option, max_error_option, model_argument
from pincal.cli.outputs import extrapolation, print_json, print_notes, require_accuracy
from pincal.errors import Exit


@dataclass(frozen=True, kw_only=True)
class ValidateArguments:
    """Arguments of validate."""

    model: Path = model_argument()
    data: Path = argument("DATA.csv", "Measurements that the calibration did not use.")
    ignore: tuple[str, ...] = ignore_option()
    max_error: float | None = max_error_option()
    general: GeneralOptions = group("General")


@verb(
    ValidateArguments,
    examples="Example:\n  pincal validate results/model.json new_measurements.csv --max-error 0.1mm",
    exits=(Exit.INACCURATE,),
)
def validate(arguments: ValidateArguments) -> Exit:
    """Report the accuracy of a calibrated model on new measurements."""
    from pincal.calibration.calibrated import load_model
    from pincal.cli.inputs import load_table
    from pincal.measure.admit import scorable_rows
    from pincal.measure.checks import check_table
    from pincal.validate.accuracy import error_table
    from pincal.validate.lack_of_fit import replicate_statistics

    calibrated = load_model(arguments.model)
    robot = calibrated.model.chain.robot
    table = load_table(robot, arguments.data, ignore=arguments.ignore)
    calibrated.conditions(table)
    if calibrated.setup.points and calibrated.sensor_kind == table.kind:
        table = scorable_rows(table, calibrated.setup)
    check_table(robot, table, minimum=1)
    problem = calibrated.readings(table)
    error = {"calibrated": {"test": error_table(problem, calibrated.values)}}
    iso, lack = replicate_statistics(
        problem, calibrated.values, table, sigma=calibrated.sigma, covariance=calibrated.covariance
    )
    beyond, notes = extrapolation(calibrated, problem.conditions, table.rows)
    if arguments.general.as_json:
        repeated = {} if iso is None else {"iso9283": iso}
        repeated |= {} if lack is None else {"lack_of_fit": asdict(lack)}
        print_json({"rows": {"test": len(table)}, "error": error} | repeated | beyond)
    else:
        from pincal.calibration.tables import error_table as as_table
        from pincal.cli.progress import console
        from pincal.cli.tables import print_replicates

        console().print(as_table(error))
        print_replicates(iso, lack, console())
    print_notes(notes, quiet=arguments.general.quiet)
    require_accuracy(error["calibrated"]["test"]["mean_mm"], arguments.max_error, rows="new")
    return Exit.DONE
