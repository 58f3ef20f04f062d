"""Tables whose clocks step, fitted again with steps that are estimated like offset and drift."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pincal.measure.measurements import Measurements
from pincal.validate.clock_jumps import SteppingClock, SteppingClocksError


def with_steps(
    tables: Mapping[str, Measurements], found: SteppingClocksError
) -> dict[str, Measurements]:
    """Return tables whose clocks step as found, by the names of their stations.

    Raises:
        SteppingClocksError: the one given, if the course of an arm is not known, as where a table
            has its joints in another order.
    """
    again = dict(tables)
    for name, clock in found.clocks.items():
        stepping = laid_again(tables[name], clock)
        if stepping is None:
            raise found
        again[name] = stepping
    return again


def laid_again(table: Measurements, clock: SteppingClock) -> Measurements | None:
    """Return a table by another clock; None if the course of its arm is not known, as where it has
    its joints in another order.
    """
    moving = table.moving
    if moving is None or moving.course is None:
        return None
    found: Measurements = moving.course.with_clock(table, clock.clock, clock.steps)
    return found


def step_notes(tables: Mapping[str, Measurements]) -> Iterator[str]:
    """Yield what is to be said of the clocks that step."""
    for table in tables.values():
        steps = () if table.moving is None else table.moving.steps
        if not steps:
            continue
        each = ", ".join(f"by {_shown(size)} at {at:.6g} s" for at, size in steps)
        yield (
            f"{table.source}: its clock, or that of the joints, steps {each} of its stamps, as "
            "when a counted frame is lost, a clock is set, or a sample is missed by polling at "
            "nearly the rate of the device; steps are estimated like offset and drift, rows around "
            "them are left out"
        )


def _shown(size: float) -> str:
    """Return a step of a clock [s] in words."""
    return f"{size:+.4g} s" if abs(size) >= 1.0 else f"{1e3 * size:+.3g} ms"
