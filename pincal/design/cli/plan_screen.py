"""Poses to measure and motions to drive, as text that fits 100 columns."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console

from pincal.cli.screen import print_notes
from pincal.design.health import HealthCheck
from pincal.design.motion_design import MotionDesign
from pincal.design.plan_tables import motion_table, pose_count_table
from pincal.design.pose_design import PREDICTED_BY, Design
from pincal.design.study import RANDOM_DESIGNS
from pincal.discover.detectability_numbers import SIGHT
from pincal.result_table import hanging, one_line

# Observability indices that are printed; the others are in --json.
_SHOWN = ("O1", "O2")


def print_plan(found: Design | HealthCheck | MotionDesign, out: Console) -> None:
    """Print the predicted accuracy of poses to measure, or of a motion to drive."""
    if isinstance(found, HealthCheck):
        print_check(found, out)
    elif isinstance(found, MotionDesign):
        _print_motion(found, out)
    else:
        _print_design(found, out)


def _print_design(found: Design, out: Console) -> None:
    """Print the request, the candidates that constraints removed, and the predicted accuracy by
    number of poses.
    """
    n = found.found.poses
    robot = found.robot
    noise = ", ".join(
        f"{1e3 * s:.3g} {'mm' if i == 0 else 'mrad'}"
        for i, s in enumerate(found.design_model.sigma)
    )
    rig = (
        f"{robot.path.start} to {robot.tip}: {found.rig.sensor}, noise {noise}; "
        f"{found.design_model.n_free} parameters"
    )
    out.print(hanging(f"{n} poses", f"of {robot.name}, {rig}"))
    for mark, text in _design_facts(found):
        out.print(hanging(f"{mark + ':':13s}", text))
    if found.curve:
        out.print(pose_count_table(found))
    print_notes(found.notes, out)


def _print_motion(found: MotionDesign, out: Console) -> None:
    """Print the predicted accuracy of a motion with an IMU, and how many poses with an instrument
    it saves.
    """
    force, rate, place = found.noise
    noise = f"noise {force:.3g} m/s^2, {1e3 * rate:.3g} mrad/s; {1e3 * place:.3g} mm for positions"
    out.print(
        hanging(
            f"{found.time[-1]:.0f} s",
            f"of {found.robot.name}, {len(found.time)} poses, with an IMU: {noise}",
        )
    )
    error = (
        f"{1e3 * found.error:.3f} mm rms within reach from errors that an IMU can determine, "
        "base and tool fitted"
    )
    for mark, text in (
        ("candidates", found.drawn.in_words()),
        (
            "predicted",
            f"{error} (before: {1e3 * found.before:.3f} mm); {1e3 * found.lengths:.3f} mm "
            "from lengths",
        ),
        ("random", f"{1e3 * found.random:.3f} mm ({found.random / found.error:.2f} times as much)"),
    ):
        out.print(hanging(f"{mark + ':':13s}", text))
    out.print(motion_table(found))


def print_check(found: HealthCheck, out: Console) -> None:
    """Print the poses of a health check, which changes it detects and which not, and the simulated
    rates.
    """
    out.print(one_line(found.summary()), markup=False)
    if not found.is_met:
        text = (
            f"too few poses to detect {1e3 * found.notice:.3g} mm; calibrate from more poses, "
            "or reduce the noise"
        )
        out.print(hanging("not met:", text))
    for mark, text in _check_facts(found):
        out.print(hanging(f"{mark}:", text))
    print_notes(found.notes, out)


def _check_facts(found: HealthCheck) -> Iterator[tuple[str, str]]:
    """Yield the change that is hardest to detect, the simulated rates, and what a check misses."""
    hardest = found.changes[0]
    where = f"{hardest.change.name} {hardest.change.joint or ''}".strip()
    parameters = ", ".join(hardest.change.parameters)
    signal = f"signal {hardest.noncentrality:.1f}, needed {hardest.needed:.1f}"
    yield "hardest", f"{where} ({parameters}): {signal}"
    rates = (
        f"alarms in {100 * found.alarms:.1f} % of {found.draws} checks of an unchanged robot, in "
    )
    rates += (
        f"{100 * found.noticed:.1f} % of {found.draws} if the hardest change by "
        f"{1e3 * found.notice:.3g} mm has occurred"
    )
    yield "simulated", rates
    if found.absorbed:
        known = [change for change in found.absorbed if change.effect is None]
        new = len(found.absorbed) - len(known)
        parts = [*dict.fromkeys(name for change in known for name in change.parameters)]
        names = ", ".join([*parts, *([f"{new} new effects"] if new else [])])
        why = (
            "the new poses of instrument and target absorb them, or they never move any point "
            "this far"
        )
        yield "undetectable", f"{names}: {why}"
    curves = "free curves of a drive, and dependences on temperature, time or direction of approach"
    yield "not covered", curves
    yield "candidates", found.drawn.in_words()


def _design_facts(found: Design) -> Iterator[tuple[str, str]]:
    """Yield how the poses were chosen, and their predicted accuracy compared with random ones."""
    yield "candidates", found.drawn.in_words()
    path = (
        f"{found.path_length:.1f} joint ranges from first to last pose, "
        f"{found.path_length_unordered:.1f} before ordering"
    )
    yield "path length", path
    if found.needed is not None:
        yield "accuracy", f"{found.needed} of the candidates are the fewest poses that reach it"
    yield from _error_facts(found)
    yield from _rival_facts(found)
    yield "rank", f"{found.rank} identifiable directions of the parameters"
    for name in _SHOWN:
        if name in found.observability:
            numbers = (
                f"{found.observability[name]:.3g}, random {found.observability_random[name]:.3g}"
            )
            yield f"index {name}", f"{numbers} (observability, {PREDICTED_BY[name]})"


def _error_facts(found: Design) -> Iterator[tuple[str, str]]:
    """Yield the predicted error: of the poses, without them, of random ones, and its bound."""
    designed = found.found.designed
    random = found.found.random
    yield (
        "predicted",
        f"{found.design_model.quantity} error over the task {1e3 * designed.error:.4f} mm rms, "
        "if the model has the right form",
    )
    if found.before is not None:
        yield "before", f"{1e3 * found.before.error:.4f} mm with the poses already measured"
    ratio = (
        f"{random.error / designed.error:.2f} times as much, "
        if found.criterion != "tell apart"
        else ""
    )
    yield "random", f"{1e3 * random.error:.4f} mm ({ratio}median of {RANDOM_DESIGNS} draws)"
    if found.bound is not None:
        beyond = (
            "; the refined poses are better than all candidates"
            if designed.error < found.bound
            else ""
        )
        yield (
            "lower bound",
            f"no selection of the candidates has less than {1e3 * found.bound:.4f} mm{beyond}",
        )


def _rival_facts(found: Design) -> Iterator[tuple[str, str]]:
    """Yield how well each of two effects can be told apart from the other."""
    apart = found.found.designed.apart
    by_chance = found.found.random.apart
    for mine, other, left, chance in zip(
        found.rivals, found.rivals[::-1], apart, by_chance, strict=False
    ):
        verdict = (
            "distinguishable"
            if left >= SIGHT.told_apart
            else f"not distinguishable, {SIGHT.told_apart:g} are needed"
        )
        verdict += f" (random {chance:.3g})"
        yield (
            "rivals",
            f"{mine} of typical size leaves {left:.3g} that {other} can't explain: {verdict}",
        )
