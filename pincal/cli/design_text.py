"""A design of poses as text that fits 100 columns."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from pincal.cli.screen import hanging, new_table
from pincal.design.design import Design
from pincal.design.observability import SOURCES
from pincal.design.study import RANDOM_DESIGNS
from pincal.discover.power import TOLD_APART

# Indices that are worth a line; the others are in --json.
_SHOWN = ("O1", "O2")


def print_design(found: Design, out: Console) -> None:
    """Print what was asked, what the constraints removed, what the poses will tell, and what other numbers would."""
    n, robot = found.found.poses, found.robot
    noise = ", ".join(f"{1e3 * s:.3g} {'mm' if i == 0 else 'mrad'}" for i, s in enumerate(found.foresight.sigma))
    rig = f"{robot.base} to {robot.tip}: {found.rig.sensor}, noise {noise}; {found.foresight.n_free} parameters"
    out.print(hanging(f"{n} poses", f"of {robot.name}, {rig}"))
    for mark, text in [*_candidates(found), *_promises(found), *_observability(found)]:
        out.print(hanging(f"{mark + ':':13s}", text))
    if found.curve:
        out.print(_curve_table(found))
    for note in found.notes:
        out.print(hanging("note:", note), style="yellow")


def _candidates(found: Design) -> Iterator[tuple[str, str]]:
    yield "candidates", found.drawn.in_words()
    yield "way", f"{found.way:.1f} joint ranges from first to last pose, {found.way_unordered:.1f} before ordering"


def _promises(found: Design) -> Iterator[tuple[str, str]]:
    """Yield what the poses promise beside random ones."""
    designed, random = found.found.designed, found.found.random
    if found.needed is not None:
        yield "accuracy", f"{found.needed} of the candidates are the fewest that reach it"
    what = "distance" if found.rig.sensor == "distance" else "position"
    yield "predicted", f"error of {what} over the task {1e3 * designed.error:.4f} mm rms, if the model has the right form"
    if found.before is not None:
        yield "before", f"{1e3 * found.before.error:.4f} mm with the poses measured already"
    ratio = f"{random.error / designed.error:.2f} times as much, " if found.criterion != "tell apart" else ""
    yield "random", f"{1e3 * random.error:.4f} mm ({ratio}median of {RANDOM_DESIGNS} draws)"
    if found.bound is not None:
        beyond = "; refining the poses went beyond them" if designed.error < found.bound else ""
        yield "at best", f"no choice of the candidates comes below {1e3 * found.bound:.4f} mm{beyond}"
    for mine, other, left, chance in zip(found.rivals, found.rivals[::-1], designed.apart, random.apart, strict=False):
        verdict = "told apart" if left >= TOLD_APART else f"not told apart, {TOLD_APART:g} are needed"
        verdict += f" (random {chance:.3g})"
        yield "rivals", f"{mine} of typical size leaves {left:.3g} that {other} can't explain: {verdict}"


def _observability(found: Design) -> Iterator[tuple[str, str]]:
    yield "rank", f"{found.rank} directions of the parameters are told better than they are known beforehand"
    for name in _SHOWN:
        if name in found.observability:
            numbers = f"{found.observability[name]:.3g}, random {found.observability_random[name]:.3g}"
            yield f"index {name}", f"{numbers} (observability, {SOURCES[name]})"


def _curve_table(found: Design) -> Table:
    """Return what other numbers of poses would tell."""
    apart = bool(found.found.designed.apart)
    table = new_table("How many poses? Predicted error, mm rms")
    heads = ("poses", "designed", "random", "random / designed")
    for name in heads + (("not explained, designed", "random") if apart else ()):
        table.add_column(name, justify="right")
    for point in found.curve:
        numbers = [f"{1e3 * point.designed.error:.4f}", f"{1e3 * point.random.error:.4f}"]
        numbers.append(f"{point.random.error / point.designed.error:.2f}")
        numbers += [f"{min(q.apart):.1f}" for q in (point.designed, point.random)] if apart else []
        table.add_row(str(point.poses), *numbers)
    return table
