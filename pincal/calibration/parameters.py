"""The table of a fit's parameters: value, uncertainty, status and reason."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pincal.identify.explain import explain
from pincal.identify.fit import Fit
from pincal.identify.reasons import Reason, Status
from pincal.io.result_file import ParameterRecord
from pincal.robot.se3 import placed, rotation_vectors


@dataclass(frozen=True)
class ParameterRow:
    """One line of the parameter table, SI units.

    Attributes:
        name: ``<element>.<symbol>``.
        unit: "m", "rad" or "rad/(N m)".
        nominal: what the URDF says.
        value: what was found.
        sigma: its standard deviation; that of the prior where the data say nothing, None for a given value.
        status: whether the data identify it.
        reason: why not.
        effect: that owns it; "named_point" for coordinates of sockets, anchors and points of an object.
    """

    name: str
    unit: str
    nominal: float
    value: float
    sigma: float | None
    status: Status
    reason: Reason
    effect: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``result.json``, the reason in words."""
        names = (field.name for field in fields(ParameterRecord))
        return {name: getattr(self, name) for name in names} | {"status": str(self.status), "reason": str(self.reason)}


def parameter_rows(fit: Fit) -> tuple[ParameterRow, ...]:
    """Return the parameter table of a fit; the angles of base and tool as rotation vectors of their orientation."""
    values = fit.values + np.array([p.nominal for p in fit.problem.parameters])
    for station, local in zip(fit.problem.stations, fit.problem.places, strict=True):
        chain = station.model.chain
        references = {"base": chain.base_rotation, **dict(zip(chain.targets, chain.tool_rotations, strict=True))}
        for element, rotation in references.items():
            names = {f"{element}.r{axis}" for axis in "xyz"}
            places = [i for i, p in zip(local, station.parameters, strict=True) if p.name in names]
            if len(places) == 3:
                turned = placed(rotation, np.concatenate([np.zeros(3), values[places]]))
                values[places] = rotation_vectors(turned[None, :3, :3])[0]
    return tuple(
        ParameterRow(
            name=parameter.name,
            unit=parameter.unit,
            nominal=parameter.nominal,
            value=float(value),
            sigma=None if finding.status == "fixed" else float(sigma),
            status=finding.status,
            reason=finding.reason,
            effect=parameter.effect,
        )
        for parameter, value, sigma, finding in zip(
            fit.problem.parameters, values, fit.estimate.sigma, explain(fit), strict=True
        )
    )
