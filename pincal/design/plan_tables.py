"""The tables of a design of poses or of a motion."""

from __future__ import annotations

from pincal.design.motion_design import MotionDesign
from pincal.design.pose_design import Design
from pincal.result_table import Column, Kind, Table
from pincal.units import fixed


def motion_table(found: MotionDesign) -> Table:
    """Return the predicted errors by number of poses with an instrument, alone and together with a
    motion with an IMU.
    """
    columns = [Column("poses", kind=Kind.NUMBER)]
    columns += [
        Column(name, "mm rms", Kind.NUMBER, fixed(4)) for name in ("alone", "with the motion")
    ]
    rows = tuple((poses, 1e3 * alone, 1e3 * both) for poses, (alone, both) in found.needed.items())
    return Table(
        "How many additional poses with an instrument? Predicted error", tuple(columns), rows
    )


def pose_count_table(found: Design) -> Table:
    """Return the predicted errors for several numbers of poses."""
    apart = bool(found.found.designed.apart)
    columns = [Column("poses", kind=Kind.NUMBER)]
    columns += [Column(name, "mm rms", Kind.NUMBER, fixed(4)) for name in ("designed", "random")]
    columns.append(Column("random / designed", kind=Kind.NUMBER, show=fixed(2)))
    names = ("not explained, designed", "not explained, random") if apart else ()
    columns += [Column(name, kind=Kind.NUMBER, show=fixed(1)) for name in names]
    rows = tuple(
        (p.poses, 1e3 * p.designed.error, 1e3 * p.random.error, p.random.error / p.designed.error)
        + (tuple(min(q.apart) for q in (p.designed, p.random)) if apart else ())
        for p in found.curve
    )
    return Table("How many poses? Predicted error", tuple(columns), rows)
