"""Real robots whose owners published figures, and pincal's by the same division: ``python tests/published_study.py``.

Each row is fitted by the command on a part of the measurements and judged by ``pincal validate`` on rows that the fit has
not seen. The 20 poses on which the owner of the UR5 judged are not in ``../shared/data``:
``--ur5-random FILE`` names a copy of 3D_UR5_uncalibrated_random_cleaned.csv of his repository.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import polars as pl

DATA = Path(__file__).parents[2] / "shared" / "data"
UR5 = DATA / "ur5_tracker" / "grid.csv"
UR10 = DATA / "ur10_tmac"
DELFT = DATA / "panda_sockets" / "panda_3.csv"
HOLIDAY = DATA / "holiday_sockets"
DELFT_PLACES = ("backcenter", "backright", "frontleft")


@dataclass(frozen=True)
class Case:
    """A robot, the tables that are fitted and the one that judges, options of the fit, and the owners' mean error [mm]."""

    name: str
    robot: str | Path
    fitted: tuple[Path, ...]
    judges: Path
    options: tuple[str, ...] = ()
    published: str = "-"


def cases(folder: Path, ur5_random: Path | None) -> Iterator[Case]:
    """Yield what can be tried with the data at hand; parts of tables are written into the folder."""
    if ur5_random is not None:
        judges = folder / "ur5_random.csv"
        write_ur5_random(ur5_random, judges)
        yield Case("UR5, the owner's 20 poses", "ur5", (UR5,), judges, published=".155")
    a, b = UR10 / "series_A.csv", UR10 / "series_B.csv"
    yield Case("UR10, B by every fourth row of A", "ur10", (thinned(a, 4, folder),), b)
    for place in DELFT_PLACES:
        others, judges = divided(DELFT, place, folder)
        published = "mean of the places .347 on another Panda"
        yield Case(
            f"Panda (Delft), {place} by the others", "panda", (others,), judges, sockets(DELFT_PLACES, place), published
        )
    contacts = ("--tip", "panda_hand_tcp", *holiday_lengths("AB"))
    tables = tuple(HOLIDAY / f"panda_{place}.csv" for place in "AB")
    yield Case("Panda (Holiday), C by A and B", HOLIDAY / "panda.urdf", tables, HOLIDAY / "panda_C.csv", contacts)


def sockets(places: tuple[str, ...], left_out: str) -> tuple[str, ...]:
    """Return the options for sockets of Delft's tool, which are 50 mm apart."""
    return tuple(
        word for place in places if place != left_out for word in ("--socket-distance", f"{place}/0", f"{place}/1", "50mm")
    )


def holiday_lengths(places: str) -> tuple[str, ...]:
    """Return the options for distances by calliper of the places of Holiday's plate."""
    known = {"A": (39.90, 39.92), "B": (39.97, 40.00)}
    pairs = [(f"{p}{k + 1}", f"{p}{k + 2}", d) for p in places for k, d in enumerate(known[p])]
    return tuple(word for first, second, d in pairs for word in ("--socket-distance", first, second, f"{d}mm"))


def thinned(path: Path, every: int, folder: Path) -> Path:
    """Write each so-many-th row of a table."""
    out = folder / f"{path.stem}_{every}.csv"
    pl.read_csv(path).gather_every(every).write_csv(out)
    return out


def divided(path: Path, place: str, folder: Path) -> tuple[Path, Path]:
    """Write the rows of the other places, and those of this."""
    rows = pl.read_csv(path)
    here = pl.col("socket").str.starts_with(place)
    others, judges = folder / f"without_{place}.csv", folder / f"{place}.csv"
    rows.filter(~here).write_csv(others)
    rows.filter(here).write_csv(judges)
    return others, judges


def write_ur5_random(source: Path, out: Path) -> None:
    """Write the owner's poses in the columns of his grid: what was measured is the target and the difference.

    With the opposite sign his poses miss the model of his own grid by 0.84 mm.
    """
    rows = pl.read_csv(source)
    names = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
    joints = [pl.col(f"joint_{k + 1}").radians().alias(name) for k, name in enumerate(names)]
    measured = [((pl.col(f"{axis}_t") + pl.col(f"{axis}_dif")) / 1e3).alias(axis) for axis in "xyz"]
    rows.select(*joints, *measured).write_csv(out)


def run(verb: str, *words: str | Path) -> str:
    """Return what a command prints."""
    command = [sys.executable, "-m", "pincal", verb, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 4, 6):
        raise RuntimeError(f"{verb} {words}: {done.stderr[-500:]}")
    return done.stdout


def judged(case: Case, verb: str, folder: Path) -> float:
    """Return the mean error [mm] at the rows that judge."""
    out = folder / verb
    run(verb, case.robot, *case.fitted, *case.options, "--out", out, "--quiet")
    words = run("validate", out / "model.json", case.judges, "--quiet")
    found = re.search(r"^calibrated +held out +mm +([\d.]+)", words, re.MULTILINE)
    if found is None:
        raise RuntimeError(words)
    return float(found[1])


def main(arguments: list[str] | None = None) -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ur5-random", type=Path, metavar="FILE", help="the owner's poses at which he judged")
    parser.add_argument("--only", metavar="WORD", default="", help="cases whose name has it")
    parser.add_argument("--verbs", nargs="+", choices=("calibrate", "discover"), default=("calibrate", "discover"))
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        for case in cases(Path(name), chosen.ur5_random):
            if chosen.only not in case.name:
                continue
            found = [f"{verb} {judged(case, verb, Path(name)):.3f} mm" for verb in chosen.verbs]
            print(f"{case.name}: {', '.join(found)}; its owners: {case.published}")


if __name__ == "__main__":
    main()
