"""``pincal export``: the calibrated model in other formats."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from pincal.atomic import write_whole
from pincal.cli.arguments import group, option, verb
from pincal.cli.common import GeneralOptions, model_argument
from pincal.cli.outputs import print_json
from pincal.errors import BadInputError, Exit


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Arguments of export."""

    model: Path = model_argument()
    urdf: Path | None = option("Write the calibrated URDF.", metavar="FILE.urdf")
    camera: Path | None = option("Write the camera, parameters and mount, as calibrate reads it.", metavar="FILE.json")
    general: GeneralOptions = group("General")


@verb(ExportArguments, examples="Example:\n  pincal export results/model.json --urdf calibrated.urdf")
def export(arguments: ExportArguments) -> Exit:
    """Write the calibrated URDF or camera parameters.

    The URDF is the original file with corrected joint origins, verified against the model.
    """
    from pincal.calibration.calibrated import load_model
    from pincal.io.urdf_export import calibrated_urdf

    urdf, camera = arguments.urdf, arguments.camera
    if urdf is None and camera is None:
        raise click.UsageError("give --urdf FILE.urdf, --camera FILE.json, or both")
    calibrated = load_model(arguments.model)
    written: dict[str, Any] = {}
    lines: list[str] = []
    if camera is not None:
        write_whole(camera, json.dumps(calibrated.camera(), indent=1) + "\n", advice="choose another file")
        written["camera"] = str(camera)
        lines.append(f"written to {camera}")
    if urdf is not None:
        if not calibrated.model.chain.robot.urdf:
            raise BadInputError(f"{arguments.model}: holds no URDF to correct; calibrate again from a URDF file")
        exported = calibrated_urdf(calibrated.model, calibrated.values)
        write_whole(urdf, exported.text, advice="choose another file")
        written |= {"urdf": str(urdf), "max_error_m": exported.max_error_m, "notes": list(exported.notes)}
        lines.append(f"written to {urdf}; its forward kinematics agree with the model to {exported.max_error_m:.1e} m")
        lines += [f"note: {note}" for note in exported.notes]
    if arguments.general.as_json:
        print_json(written)
    else:
        click.echo("\n".join(lines))
    return Exit.DONE
