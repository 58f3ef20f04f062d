"""What is promised of rates, each with a draw that says whether it went wrong: for ``python tests/rates.py --add FILE``."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import diagnosis_cases
import numpy as np
from discovery_cases import FOREIGN, NAMED, SOFT, Verdict, draw_case, fresh, judge
from stop_cases import MeasuredRobot, MeasuringPlan

import pincal
from pincal.calibration.placing import place_station
from pincal.diagnosis.robot_diagnosis import changes_since
from pincal.errors import PincalWarning

# What of lambda has to be left, beside masses known to some per cent, for an effect to be seen; of a searched wave more.
_VISIBLE, _SEARCHED = 40.0, 80.0
# Effects that uncertain masses imitate, and the one outside the catalogue that it nearly describes.
_IMITATED = ("gravity_compensator", "payload_error")
_LIKE_A_NAME = "cubed_tilt"
_PAIRED = ("gear_eccentricity", "backlash", "joint_coupling", "base_elasticity", "thermal_offset", "link_bending")
# An alarm of a diagnosis at this level.
_ALPHA = 0.01
_CHECKS = (MeasuringPlan(20), MeasuringPlan(10, visits=3), MeasuringPlan(20, dwell=3), MeasuringPlan(12, targets=3))


@dataclass(frozen=True)
class Claim:
    """A rate that is promised.

    Attributes:
        name: in files.
        words: what would be wrong.
        rate: in which part of the draws it may be, at most.
        is_wrong: returns of a seed whether it is; None where the draw tells nothing.
    """

    name: str
    words: str
    rate: float
    is_wrong: Callable[[int], bool | None]


def _discovered(kind: str, seed: int, options: dict[str, Any]) -> Verdict:
    rows = int(np.random.default_rng(seed).integers(150, 301))
    return judge(draw_case(kind, seed, **{"n": rows, **options}))


def _named_without_effect(options: dict[str, Any], seed: int) -> bool:
    return _discovered("null", seed, {**(fresh(seed) if options == {"masses": 0.03} else {}), **options}).detected


def _hidden(seed: int) -> Verdict | None:
    kinds = (*NAMED, *SOFT)
    found = _discovered(kinds[seed % len(kinds)], seed, fresh(seed))
    return found if found.seen >= (_SEARCHED if found.kind == "gear_ripple" else _VISIBLE) else None


def _hidden_not_named(seed: int) -> bool | None:
    found = _hidden(seed)
    return None if found is None or found.kind in _IMITATED else not found.right


def _false_name_beside(seed: int) -> bool | None:
    found = _hidden(seed)
    return None if found is None else bool(found.false_names)


def _pair_not_named(seed: int) -> bool | None:
    first, second = np.random.default_rng(seed).choice(_PAIRED, 2, replace=False)
    found = _discovered(f"{first}+{second}", seed, {})
    return not found.right if found.seen >= _VISIBLE else None


def _foreign_named(seed: int) -> bool | None:
    kinds = [kind for kind in FOREIGN if kind != _LIKE_A_NAME]
    found = _discovered(kinds[seed % len(kinds)], seed, {})
    return bool(found.false_names) if found.seen >= _VISIBLE else None


def _alarm(options: dict[str, Any], seed: int) -> bool | None:
    case = diagnosis_cases.draw_case(seed, temperature=seed % 9 < 3, **options)
    return None if case is None else changes_since(case.model, place_station(case.model, case.new), _ALPHA).changed


def _alarm_of_stops(seed: int) -> bool:
    rng = np.random.default_rng(seed)
    robot = MeasuredRobot.drawn(rng)
    model = robot.calibrated(MeasuringPlan(60), rng)
    return pincal.diagnose(model, robot.measured(_CHECKS[seed % len(_CHECKS)], rng)).changed


_SOUND = (
    ("masses", "masses 3 % off", {"masses": 0.03}, 0.01),
    ("heavy_masses", "masses 10 % off", {"masses": 0.1}, 0.05),
    ("outliers", "outliers", {"noise": "outliers"}, 0.03),
    ("heavy_tails", "heavy tails", {"noise": "heavy"}, 0.03),
    ("rigid", "a rigid arm", {"elastic": False}, 0.02),
)
CLAIMS = (
    *(
        Claim(f"name_{key}", f"a name in data without an effect ({words})", rate, partial(_named_without_effect, options))
        for key, words, options, rate in _SOUND
    ),
    Claim("not_named", "an effect that can be seen, and that masses can't imitate, not named", 0.03, _hidden_not_named),
    Claim("false_name", "a false name beside a hidden effect", 0.02, _false_name_beside),
    Claim("pair", "one of two effects not named", 0.05, _pair_not_named),
    Claim("foreign", "a name for an effect outside the catalogue", 0.05, _foreign_named),
    Claim("alarm", "an alarm for a robot that has not changed", 0.015, partial(_alarm, {})),
    Claim("alarm_missed", "the same, three strong effects missed by its model", 0.015, partial(_alarm, {"missed": 3})),
    Claim("alarm_stops", "the same by repeats, cycles and targets", 0.015, _alarm_of_stops),
)


def is_wrong(task: tuple[str, int]) -> bool | None:
    """Return whether a claim's draw, by its name and seed, went wrong; None where it tells nothing."""
    warnings.simplefilter("ignore", PincalWarning)
    name, seed = task
    return next(claim for claim in CLAIMS if claim.name == name).is_wrong(seed)
