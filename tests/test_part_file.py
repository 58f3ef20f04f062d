"""Files of parts: what they say in SI units, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from pincal.errors import BadInputError
from pincal.features.part import Part

DOOR = """
unit = "mm"
points = "nominals.csv"

[feature.top]
kind = "plane"
nominal = [0, 0, 10]
normal = [0, 0, 2]
tolerance_um = 300

[feature.hole_1]
kind = "circle"
nominal_mm = [120.0, 40.0, 0.0]
direction = [0, 0, 1]
diameter_mm = 12.0
tolerance = { x = 0.3, position_mm = 0.5, direction_mrad = 2, diameter_mm = [-0.05, 0.10] }

[feature.hole_2]
kind = "circle"
radius = "0.5 cm"
diameter_tolerance = 0.1

[feature.ball]
kind = "sphere"
nominal_um = { x = 1, y = "2 mm", z_m = 3, diameter = 30000 }
tolerance_um = { diameter = 20 }

[feature.pitch]
kind = "distance"
of = ["hole_1", "hole_2"]
nominal = "8 cm"
limits_mm = [79.8, 80.3]

[feature.corner]
kind = "angle"
of = ["top", "hole_1"]
unit = "deg"
nominal = 90
tolerance_mrad = 1

[datum]
kind = "3-2-1"
features = ["top", "hole_1", "p_1"]
"""
POINTS = "name;x [mm];y [mm];z [mm];tolerance [mm]\np_1;1,5;2;3;0,1\nhole_2;200;40;0;0,2\n"


def read(folder: Path, text: str, points: str = POINTS) -> Part:
    """Return the part of a text."""
    (folder / "nominals.csv").write_text(points)
    (folder / "door.toml").write_text(text)
    return Part.from_toml(folder / "door.toml")


def test_values_are_in_si_units(tmp_path: Path) -> None:
    """Units stand in keys, in values, at the top, or in the header of the table of points."""
    part = read(tmp_path, DOOR)
    of = part.features

    assert list(of) == ["top", "hole_1", "hole_2", "ball", "pitch", "corner", "p_1"]
    assert of["top"].position == pytest.approx([0.0, 0.0, 0.01])
    assert of["top"].direction == pytest.approx([0.0, 0.0, 1.0])
    assert of["top"].limits["offset"].upper == pytest.approx(3e-4)
    limits = {name: (its.lower, its.upper) for name, its in of["hole_1"].limits.items()}
    assert limits["x"] == pytest.approx((0.1197, 0.1203))
    assert limits["position"] == (-np.inf, pytest.approx(5e-4))
    assert limits["tilt"] == (-np.inf, pytest.approx(2e-3))
    assert limits["diameter"] == pytest.approx((0.01195, 0.0121))
    assert of["hole_2"].nominal == {"diameter": pytest.approx(0.01)}
    assert of["hole_2"].position == pytest.approx([0.2, 0.04, 0.0])
    assert of["ball"].position == pytest.approx([1e-6, 2e-3, 3.0])
    assert of["ball"].limits["diameter"].lower == pytest.approx(0.02998)
    assert of["pitch"].nominal_of("distance") == pytest.approx(0.08)
    assert of["pitch"].limits["distance"].upper == pytest.approx(0.0803)
    assert of["corner"].limits["angle"].lower == pytest.approx(np.pi / 2 - 1e-3)
    assert of["p_1"].limits["y"].lower == pytest.approx(0.0019)
    assert part.datum.features == ("top", "hole_1", "p_1")
    assert part.kinds.keys() == {"top", "hole_1", "hole_2", "ball", "p_1"}


POINT = '[feature.a]\nkind = "point"\n'
REFUSED = {
    "no TOML": ("[feature", "can't be read"),
    "nothing": ("", "no features"),
    "top key": ("units = 'mm'\n" + POINT, "'units'; expected one of unit"),
    "top unit": ("unit = 'furlong'\n" + POINT, "furlong"),
    "kind": ("[feature.a]\nkind = 'circel'", "expected one of circle"),
    "key": (POINT + "nominal_mn = [1, 2, 3]", "nominal_mm"),
    "no kind": ("[feature.a]\nnominal_mm = 3", "no kind; expected one of"),
    "key of another kind": (POINT + "diameter_mm = 3", "unknown key 'diameter_mm'"),
    "no unit": (POINT + "nominal = [1, 2, 3]", "a unit: nominal_mm = ..."),
    "no unit of an angle": (
        "unit = 'mm'\n[feature.a]\nkind = 'plane'\n[feature.b]\nkind = 'plane'\n"
        "[feature.w]\nkind = 'angle'\nof = ['a', 'b']\nnominal = 90",
        "nominal_deg = ..., or angle_unit = 'deg' at the top",
    ),
    "unit of a feature": (POINT + "unit = 'furlong'\nnominal = [1, 2, 3]", "unit = 'furlong'; expected one of m"),
    "two of three": (POINT + "nominal_mm = {x = 1, y = 2}", "no z; expected x, y and z"),
    "place twice": (POINT + "position_mm = [1, 2, 3]\nnominal_mm = {x = 1, y = 2, z = 3}", "one nominal position"),
    "two directions": ("[feature.a]\nkind = 'plane'\nnormal = [0, 0, 1]\naxis = [0, 1, 0]", "one nominal direction"),
    "two units": (POINT + "nominal_mm = ['1 mm', 2, 3]", "as the key has mm"),
    "twice": (POINT + "nominal_mm = [1, 2, 3]\nnominal_m = [1, 2, 3]", "twice"),
    "position twice": (POINT + "nominal_mm = [1, 2, 3]\nposition_mm = [1, 2, 3]", "one nominal position"),
    "count": (POINT + "nominal_mm = [1, 2]", "3 numbers"),
    "number": (POINT + "nominal_mm = [1, 2, true]", "expected a number"),
    "huge": (POINT + "nominal_mm = [1, 2, 1e300]", "plausible"),
    "nan": (POINT + "nominal_mm = [1, 2, nan]", "plausible"),
    "tolerance of nothing": (POINT + "tolerance_mm = 1", "a nominal x"),
    "tolerance of 0": (POINT + "nominal_mm = [1, 2, 3]\ntolerance_mm = 0", "more than 0"),
    "limits turned": (POINT + "limits = {x_mm = [2, 1]}", "least value before"),
    "limits of a place": (POINT + "nominal_mm = [1, 2, 3]\nlimits_mm = [2, 3]", "a table of pairs"),
    "tolerance and limits": (
        POINT + "nominal_mm = [1, 2, 3]\nlimits = {x_mm = [1, 2]}\ntolerance_mm = 1",
        "limits already",
    ),
    "of what": (
        "[feature.a]\nkind = 'circle'\nposition_mm = [1, 2, 3]\ntolerance_mm = 1",
        "names what it is of",
    ),
    "direction of 0": ("[feature.a]\nkind = 'plane'\ndirection = [0, 0, 0]", "not all 0"),
    "negative": ("[feature.a]\nkind = 'circle'\ndiameter_mm = -3", "the nominal diameter is below 0 (-0.003 m)"),
    "of one": (POINT + "[feature.d]\nkind = 'distance'\nof = ['a']", "two features"),
    "of itself": (POINT + "[feature.d]\nkind = 'distance'\nof = ['a', 'd']", "distance itself"),
    "of unknown": (POINT + "[feature.d]\nkind = 'distance'\nof = ['a', 'b']", "'b', which is no feature"),
    "angle of points": (
        POINT + "[feature.b]\nkind = 'line'\n[feature.d]\nkind = 'angle'\nof = ['a', 'b']",
        "without a direction",
    ),
    "datum": (POINT + "[datum]\nkind = 'bestfit'", "best fit"),
    "datum of two": (POINT + "[datum]\nkind = '3-2-1'\nfeatures = ['a']", "expected three"),
    "datum of unknown": (POINT + "[datum]\nkind = 'best fit'\nfeatures = ['b']", "no measured feature"),
    "datum without nominal": (POINT + "[datum]\nkind = 'best fit'\nfeatures = ['a']", "no nominal position"),
    "datum of nothing": (POINT + "[datum]\nkind = 'best fit'", "no features"),
    "datum of one twice": (
        POINT + "nominal_mm = [1, 2, 3]\n[datum]\nkind = 'best fit'\nfeatures = ['a', 'a']",
        "'a' occurs twice; expected each feature once",
    ),
    "datum of three, one twice": (
        POINT + "nominal_mm = [1, 2, 3]\n[datum]\nkind = '3-2-1'\nfeatures = ['a', 'a', 'a']",
        "'a' occurs twice; expected each feature once",
    ),
    "calibrated datum": (POINT + "[datum]\nkind = 'calibrated'\nfeatures = ['a']", "takes none"),
    "no points": ("points = 'absent.csv'", "absent.csv"),
    "points of a plane": ("points = 'nominals.csv'\n[feature.p_1]\nkind = 'plane'", "another name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_part_is_refused(case: str, tmp_path: Path) -> None:
    """With file and key, what was found and what is expected."""
    text, words = REFUSED[case]

    with pytest.raises(BadInputError) as error:
        read(tmp_path, text)

    assert words in str(error.value)
    assert "door.toml" in str(error.value) or "absent.csv" in str(error.value)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("name,x,y,z,tolerance\np,1,2,3,0.1\nq,1,2,4,\n", 'line 3, column "tolerance"'),
        ("name,x,y,z\np,1,2,3\nq,1,,4\n", 'line 3, column "y"'),
        ("name,x,y,z,tolerance\np,1,2,3,-0.001\n", "'p' has the tolerance -1 mm; expected more than 0"),
    ],
)
def test_no_point_of_a_table_is_lost(tmp_path: Path, table: str, words: str) -> None:
    """An empty cell or a tolerance below 0 is refused: without its row, a feature would not be judged."""
    with pytest.raises(BadInputError, match=words):
        read(tmp_path, "points = 'nominals.csv'", table)


def test_a_point_that_stands_twice_in_its_table_is_refused(tmp_path: Path) -> None:
    """By its name."""
    with pytest.raises(BadInputError, match="'p' occurs twice"):
        read(tmp_path, "points = 'nominals.csv'", "name,x,y,z\np,1,2,3\np,1,2,4\n")
