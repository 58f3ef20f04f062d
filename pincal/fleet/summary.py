"""What a person asks of a type: how far machines differ, what is wrong with the data sheet, which do not belong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.fleet.history import FleetChange, FleetHistory
from pincal.fleet.robot_type import Learned, Membership, RobotType
from pincal.parameters import root_of
from pincal.result_table import Cell, Column, Kind, Table
from pincal.units import Quantity, fixed, format_readable, show_percent, show_sigma, show_unit, show_value

# Poses at which the tool is compared, and machines drawn for exchangeability, of which ISO 9283 compares five.
_POSES, _DRAWN, _COMPARED = 200, 200, 5
# Numbers of poses for which the error of a further machine is foreseen, and sets of poses of each.
_NUMBERS, _SETS = (4, 6, 8, 10, 12, 15, 20, 25, 30, 40, 60), 8
# Chance that any machine of the type is said not to belong.
_ALPHA = 0.05
# Part of a parameter that readings have to tell for its numbers to mean anything.
_DETERMINED = 0.05
# 95 % of a normal distribution lie within so many standard deviations.
_INTERVAL = 1.96


@dataclass(frozen=True)
class AtTool:
    """How far machines of a type differ at the tool once base and tool are placed, over random poses [m].

    Attributes:
        spread: root mean square distance of a machine from the mean one.
        by_effect: the same by each effect alone.
        sheet: root mean square distance of the mean machine from the nominal one.
        exchangeability: largest distance between any two of five machines at the same joint positions, mean over poses and
            draws (exchangeability of ISO 9283, at random poses).
        needed: number of poses -> foreseen root mean square error of a further machine with this type, and without.
    """

    spread: float
    by_effect: dict[str, float]
    sheet: float
    exchangeability: float
    needed: dict[int, tuple[float, float]]

    def poses_for(self, error: float) -> tuple[int | None, int | None]:
        """Return the fewest poses that reach an error [m], with the type and without; None if more than are foreseen."""
        with_type, without = (next((poses for poses, both in self.needed.items() if both[k] <= error), None) for k in (0, 1))
        return with_type, without


def at_tool(of: RobotType, model: CalibratedModel, *, noise: float = 5e-5, seed: int = 0) -> AtTool:
    """Return how far machines of a type differ at the tool.

    Args:
        of: the type.
        model: of any machine of the type, with position readings in mind; its effects and its tool are used.
        noise: of one component of a position [m].
        seed: of the poses.

    Raises:
        BadInputError: if the model has none of the type's parameters.
    """
    names, rng = model.model.names, np.random.default_rng(seed)
    own = [k for k, name in enumerate(names) if name in of.names]
    places = [of.names.index(names[k]) for k in own]
    frames = [k for k, parameter in enumerate(model.model.parameters) if parameter.is_extrinsic]
    if not own:
        name = model.model.chain.robot.name
        raise BadInputError(f"the model of {name} has no parameter of the type; expected one of its machines")

    def rows(poses: int) -> tuple[np.ndarray, np.ndarray]:
        q = model.model.chain.robot.random_configurations(poses, rng)
        _, J = model.model.linearise(model.model_values, model.conditions_at(q))
        J = J.reshape(-1, J.shape[-1])
        return J[:, frames], J[:, own]

    scale = of.priors[places]
    prior = of.prior(names=[of.names[k] for k in places]).dense_covariance()
    F, J = rows(_POSES)
    # What a rigid displacement of base and tool takes away is no difference.
    placed = J - F @ np.linalg.lstsq(F, J, rcond=None)[0]
    covariance, seen = of.covariance[np.ix_(places, places)], of.seen[np.ix_(places, places)]
    known = seen * np.outer(scale, 1.0 / scale)
    covariance = known @ covariance @ known.T
    moved = placed @ root_of(covariance)
    effects = dict.fromkeys(of.parameters[k].effect for k in places)
    by_effect = {}
    for effect in effects:
        at = np.array([of.parameters[k].effect == effect for k in places])
        by_effect[effect] = _rms(placed[:, at] @ root_of(covariance[np.ix_(at, at)]))
    drawn = (rng.normal(size=(_DRAWN, _COMPARED, moved.shape[1])) @ moved.T).reshape(_DRAWN, _COMPARED, -1, 3)
    apart = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=-1).max(axis=(1, 2))
    needed = {}
    for poses in _NUMBERS:
        sets = [rows(poses) for _ in range(_SETS)]
        each = [[_foreseen(one, (F, J), C, noise) for C in (prior, np.diag(scale**2))] for one in sets]
        with_type, without = np.median(each, axis=0)
        needed[poses] = float(with_type), float(without)
    sheet = placed @ (known @ of.mean[places])
    return AtTool(_rms(moved), by_effect, _rms(sheet[:, None]), float(apart.mean()), needed)


def _rms(moved: np.ndarray) -> float:
    """Return the root mean square length of displacements, shape (3 N, n), over n independent unit numbers."""
    return float(np.sqrt(3.0 * np.mean(np.sum(moved**2, axis=1))))


def _foreseen(
    measured: tuple[np.ndarray, np.ndarray], at: tuple[np.ndarray, np.ndarray], prior: np.ndarray, noise: float
) -> float:
    """Return the error that is to be expected at poses if others are measured, each given by its Jacobians."""
    F, J = measured
    root = root_of(prior)
    A = np.hstack([F, J @ root]) / noise
    # Frames have no prior: a kilometre, in units that keep the sum well conditioned.
    weights = np.concatenate([np.full(F.shape[1], 1e-3), np.ones(root.shape[1])])
    covariance = np.linalg.inv(A.T @ A + np.diag(weights**2))
    return _rms(np.hstack([at[0], at[1] @ root]) @ root_of(covariance))


def parameter_summary(of: RobotType) -> Table:
    """Return how far the data sheet is off and how far machines differ, by parameter."""
    share = np.diag(of.seen)
    sheet, sigma = of.mean, np.sqrt(np.diag(of.mean_covariance))
    spread = np.sqrt(np.diag(of.covariance))
    columns = (
        Column("parameter", kind=Kind.NAME),
        Column("unit", kind=Kind.LABEL, show=show_unit),
        Column("mean", kind=Kind.NUMBER, show=show_value),
        Column("95 %", kind=Kind.NUMBER, show=show_sigma),
        Column("differ", kind=Kind.NUMBER, show=show_sigma),
        Column("determined", kind=Kind.NUMBER, show=show_percent),
    )
    rows = list[tuple[Cell, ...]]()
    for k, p in enumerate(of.parameters):
        numbers = (Quantity(float(x), p.unit) for x in (sheet[k], _INTERVAL * sigma[k], spread[k]))
        rows.append((p.name, p.unit, *(numbers if share[k] > _DETERMINED else (None,) * 3), float(share[k])))
    note = (
        "mean: of all machines minus the data sheet, with half the width of its 95 % interval; differ: standard deviation "
    )
    note += "of machines; determined: how far readings tell the parameter from others, the rest is a matter of convention"
    return Table("Machines of the type", columns, tuple(rows), (note,))


def effect_summary(found: AtTool) -> Table:
    """Return how far machines differ at the tool, by effect."""
    columns = (Column("effect", kind=Kind.LABEL), Column("at the tool", "mm", Kind.NUMBER, fixed(3)))
    rows = [(effect, 1e3 * size) for effect, size in sorted(found.by_effect.items(), key=lambda one: -one[1])]
    notes = (
        f"machines differ from their mean by {1e3 * found.spread:.3f} mm rms at the tool, base and tool placed",
        f"the mean machine is {1e3 * found.sheet:.3f} mm off the data sheet",
        f"exchangeability (ISO 9283, five machines): {1e3 * found.exchangeability:.3f} mm",
    )
    return Table("How far machines differ", columns, tuple(rows), notes)


def poses_summary(found: AtTool) -> Table:
    """Return the error that is foreseen for a further machine by the number of its poses."""
    columns = (
        Column("poses", kind=Kind.NUMBER),
        Column("with the type", "mm", Kind.NUMBER, fixed(3)),
        Column("without", "mm", Kind.NUMBER, fixed(3)),
    )
    rows = tuple((poses, *(1e3 * error for error in both)) for poses, both in found.needed.items())
    return Table("Error of a further machine by random poses", columns, rows)


def strangers(members: Sequence[Membership]) -> list[tuple[Membership, float]]:
    """Return machines that do not belong to their type, with p-values adjusted for their number (Holm 1979)."""
    ranked = sorted(members, key=lambda one: one.p_value)
    found, largest = list[tuple[Membership, float]](), 0.0
    for k, member in enumerate(ranked):
        largest = max(largest, min(1.0, member.p_value * (len(ranked) - k)))
        if largest < _ALPHA and member.off:
            found.append((member, largest))
    return found


def member_summary(learned: Learned) -> Table:
    """Return the machines that do not belong to the type, the least likely first."""
    columns = (
        Column("machine", kind=Kind.NAME),
        Column("p", kind=Kind.NUMBER, show="{:.2g}".format),
        Column("differs in", kind=Kind.NAME),
    )
    rows = [(member.machine or "-", p, ", ".join(member.off)) for member, p in strangers(learned.members)]
    count = f"{len(learned.members)} machines, of which {100 * learned.type.hit:.1f} % are estimated to be unlike the others"
    return Table("Machines that do not belong", columns, tuple(rows), (count,))


def change_summary(found: FleetHistory) -> Table:
    """Return what changed in a fleet, the latest first."""
    columns = (
        Column("machine or group", kind=Kind.NAME),
        Column("since", kind=Kind.LABEL),
        Column("found", kind=Kind.LABEL),
        Column("what", kind=Kind.NAME),
        Column("by", kind=Kind.LABEL),
        Column("log10 e", kind=Kind.NUMBER, show=fixed(1)),
    )
    rows = [
        (one.subject, one.since, one.found, " or ".join((one.what, *one.equals[:3])), _by(one), one.log_e / np.log(10.0))
        for one in reversed(found.changes)
    ]
    return Table("Changes", columns, tuple(rows), tuple(_counts(found)))


def _by(change: FleetChange) -> str:
    return "-" if change.change is None else format_readable(change.change, change.unit, "+.3f")


def _counts(found: FleetHistory) -> Iterator[str]:
    groups = sum(change.is_group for change in found.changes)
    yield f"{found.checks} checks of {found.robots} machines: {len(found.changes) - groups} changed, {groups} groups drifted"
