"""How often discovery is right: on random arms, with hidden effects of known strength, and with none.

The strength lambda is the squared signal that a refitted elastic model can't absorb, over the noise variance. Two further
things take their part of it before a discovery can see it: a fifth of the poses, held out in whole regions, and masses,
which no URDF knows better than to some per cent (``Case.seen`` is what they leave). Bounds are rates that are reached,
tested so that chance alone fails them once in a thousand sets of draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest
from discovery_cases import FOREIGN, NAMED, SOFT, Verdict, discover, draw_case, fresh, gap_over_oracle, judge, summary
from rates import is_at_least, is_at_most

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# What of lambda has to be left for 99 of 100 to be found: 26 for one parameter at this chance of a false name.
VISIBLE = 40.0
# The same of a wave whose order is searched for: it is the highest of some thousands.
SEARCHED = 80.0
# From this seed on arms are those whose frames are anywhere.
FRESH = 100
# Effects that uncertain masses can imitate: a spring has the first harmonic of a link's weight, and a payload
# that is 5 % too heavy is all links 5 % too light and all compliances to match. Their median share of lambda that is left
# beside masses known to 5 % is 0.33 and 0.26, against 0.76 for the others.
IMITATED = ("gravity_compensator", "payload_error")
# sin^3 is (3 sin q - sin 3q) / 4. Of the first order half is geometry; of the rest an axis wobble of order 2, seen from
# the link, takes all but one of four circles: 9 % of the signal. And a tilt across joint 5 along y is the turn of joint 4.
LIKE_A_NAME = "cubed_tilt"
# Tables in which nothing is hidden: how they are drawn, in which part of them a name is no surprise, and how many there are.
SOUND: list[tuple[dict[str, Any], float, int]] = [
    ({"masses": 0.03}, 0.01, 40),
    ({"masses": 0.1}, 0.05, 25),
    ({"noise": "outliers"}, 0.03, 25),
    ({"noise": "heavy"}, 0.03, 25),
    ({"elastic": False}, 0.02, 15),
]
PAIRS = [
    "+".join(pair)
    for pair in combinations(
        ("gear_eccentricity", "backlash", "joint_coupling", "base_elasticity", "thermal_offset", "link_bending"), 2
    )
]
# Cases of each kind: hidden effects, pairs of them, and what is not in the catalogue.
HIDDEN_EACH, PAIRS_EACH, FOREIGN_EACH = 6, 2, 8
# What the long tests allow, as the page of promises says it: what is wrong, in which part of tables, how many are drawn
# (those in which something can be seen are fewer), and the test.
_NAMED = "test_hidden_effects_are_found_and_named"
_UNNAMED = "test_effects_outside_the_catalogue_get_no_name"
_SOUND = ("masses 3 % off", "masses 10 % off", "outliers", "heavy tails", "a rigid arm")
CI: list[tuple[str, float, int, str]] = [
    *(
        (f"a name in data without an effect ({words})", rate, n, "test_sound_data_bring_in_no_name")
        for words, (_, rate, n) in zip(_SOUND, SOUND, strict=True)
    ),
    ("an effect that masses can't imitate not named", 0.03, HIDDEN_EACH * len({*NAMED, *SOFT} - {*IMITATED}), _NAMED),
    ("a false name in addition to a hidden effect", 0.02, HIDDEN_EACH * len({*NAMED, *SOFT}), _NAMED),
    ("one of two effects not named", 0.05, PAIRS_EACH * len(PAIRS), "test_two_hidden_effects_are_both_named"),
    ("an effect outside the catalogue at another joint", 0.05, FOREIGN_EACH * (len(FOREIGN) - 1), _UNNAMED),
    ("a name for an effect outside the catalogue", 0.05, FOREIGN_EACH * len(FOREIGN), _UNNAMED),
]


def verdict_of(task: tuple[str, int, dict[str, Any]]) -> tuple[Verdict, float]:
    """Return what a discovery makes of one case, and its gap over that of a fit that knows what is hidden."""
    kind, seed, options = task
    options = {"n": int(np.random.default_rng(seed).integers(150, 301))} | options
    case = draw_case(kind, seed, **options)
    trail = discover(case)
    named = kind in NAMED and case.seen >= VISIBLE
    return judge(case, trail), gap_over_oracle(case, trail) if named else np.nan


def verdicts_of(kinds: Sequence[str], seeds: Sequence[int], **options: Any) -> tuple[list[Verdict], np.ndarray]:
    """Return verdicts and gaps on all kinds and seeds."""
    return verdicts_on([(kind, seed, options) for kind in kinds for seed in seeds])


def verdicts_on(tasks: list[tuple[str, int, dict[str, Any]]]) -> tuple[list[Verdict], np.ndarray]:
    """Return verdicts and gaps of some cases, and print them as a table, with those that went wrong."""
    with ProcessPoolExecutor(2, mp_context=get_context("forkserver")) as pool:
        found = list(pool.map(verdict_of, tasks, chunksize=4))
    verdicts = [verdict for verdict, _ in found]
    wrong = [v for v in verdicts if v.false_names or not v.sound or not (v.right or v.kind == "measurement_scale")]
    print("\n".join(["", summary(verdicts), *map(str, wrong)]))
    return verdicts, np.array([gap for _, gap in found])


def fresh_tasks(kinds: Sequence[str], count: int) -> list[tuple[str, int, dict[str, Any]]]:
    """Return some cases of each kind on arms whose frames are anywhere, all classes of them in turn."""
    seeds = range(9000, 9000 + count * len(kinds))
    return [(kinds[i // count], seed, fresh(seed)) for i, seed in enumerate(seeds)]


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("gear_eccentricity", 1),
        *(
            pytest.param(kind, seed, marks=pytest.mark.long)
            for kind, seed in [
                ("joint_coupling", 100),
                ("load_backlash", 1),
                ("axis_wobble", 3),
                ("gear_ratio+backlash", 2),
                # Tilts with the link before the first joint: as a bearing in the other convention, but not as far.
                ("base_elasticity", 9662),
            ]
        ),
        # It is one of the hidden examples.
        pytest.param("thermal_expansion", 0, marks=[pytest.mark.long, pytest.mark.rates]),
    ],
)
def test_a_hidden_effect_is_named_with_its_joint(kind: str, seed: int) -> None:
    """One of each class of arms; the held-out gap is that of a fit that knows the truth."""
    anywhere = fresh(seed) if seed >= FRESH else {}
    case = draw_case(kind, seed, **{**anywhere, "n": 200, "strength": 150.0})
    trail = discover(case)
    verdict = judge(case, trail)

    assert verdict.right and verdict.sound and not verdict.false_names, str(verdict)
    assert gap_over_oracle(case, trail) < 1.1


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        # Every sixth before each commit, all of them where rates are counted.
        pytest.param(kind, 9700 + i, marks=pytest.mark.rates if i % 6 else ())
        for i, kind in enumerate((*NAMED, *SOFT, *FOREIGN, *(6 * ("null",))))
    ],
)
def test_drawn_cases_come_out_as_they_are_known_to(kind: str, seed: int) -> None:
    """One of each kind on an arm whose frames are anywhere, the first that was drawn, and six without an effect."""
    strength = {} if kind == "null" else {"strength": 150.0}
    verdict = judge(draw_case(kind, seed, **{**fresh(seed), "n": 200, **strength}))

    assert verdict.right and verdict.sound and not verdict.false_names, str(verdict)
    assert len(verdict.named) == (0 if kind == "null" else 1)


@pytest.mark.long
def test_a_whole_curve_takes_the_place_of_its_part() -> None:
    """An irregular gear of which a wave explains most: the wave alone left a quarter more at other poses."""
    case = draw_case("transmission_error", 9011, **fresh(9011))
    trail = discover(case)

    assert judge(case, trail).first_right
    assert gap_over_oracle(case, trail) < 1.1


@pytest.mark.long
def test_a_name_stays_that_the_others_take_over_only_to_first_order() -> None:
    """A bearing's compliance times its place seemed to do what the last joint's gear does; fitted again they did not."""
    case = draw_case("gear_eccentricity", 77006, **fresh(77006))
    trail = discover(case)

    assert judge(case, trail).right
    assert gap_over_oracle(case, trail) < 1.1


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.long) for kind in ("product", "step", LIKE_A_NAME)])
def test_what_has_no_name_gets_none(kind: str) -> None:
    """A jump of a drive, the product of two joints' sines and a tilt by sin^3 are found at their joint, without a name."""
    verdict = judge(draw_case(kind, 2, n=200, strength=150.0))

    assert verdict.right and not verdict.false_names, str(verdict)


@pytest.mark.parametrize("kind", ["null", pytest.param("measurement_scale", marks=pytest.mark.long)])
def test_nothing_is_named_where_nothing_can_be_seen(kind: str) -> None:
    """Sound data with masses 3 % off, and an instrument's scale, which free lengths absorb: no name."""
    assert not judge(draw_case(kind, 4, n=200)).named


@pytest.mark.long
@pytest.mark.rates
def test_hidden_effects_are_found_and_named() -> None:
    """Of 18 kinds, on arms whose axes meet at any angle and whose frames are anywhere; alone or among equivalents."""
    verdicts, gaps = verdicts_on(fresh_tasks((*NAMED, *SOFT), HIDDEN_EACH))
    visible = [v for v in verdicts if v.seen >= (SEARCHED if v.kind == "gear_ripple" else VISIBLE)]
    plain = [v for v in verdicts if v.kind not in IMITATED]
    known = gaps[np.isfinite(gaps)]
    shares = (f"{sum(v.right for v in some)} of {len(some)}" for some in (verdicts, plain, visible))
    print("right of all, of those that masses can't imitate, of those that can be seen: " + ", ".join(shares))
    print(f"gap over oracle {np.quantile(known, [0.5, 0.95])}")

    assert is_at_least(0.99, [v.detected for v in visible])
    assert is_at_least(0.97, [v.right for v in visible])
    assert is_at_least(0.97, [v.detected for v in plain])
    assert is_at_least(0.97, [v.right for v in plain])
    assert is_at_least(0.97, [v.right and not v.false_names and v.sound for v in verdicts if v.kind in SOFT])
    assert is_at_least(0.95, [v.right for v in verdicts if v.kind in IMITATED and v.detected])
    assert is_at_most(0.02, [bool(v.false_names) for v in visible])
    assert np.median([v.class_size for v in verdicts if v.class_size]) <= 2
    assert is_at_least(0.99, [v.sound for v in verdicts])
    assert np.median(known) <= 1.02 and np.quantile(known, 0.95) <= 1.15


@pytest.mark.long
@pytest.mark.rates
def test_two_hidden_effects_are_both_named() -> None:
    """All pairs of six kinds."""
    verdicts, _ = verdicts_of(PAIRS, range(8100, 8100 + PAIRS_EACH))

    assert is_at_least(0.95, [v.right for v in verdicts if v.seen >= VISIBLE])
    assert is_at_most(0.05, [bool(v.false_names) for v in verdicts])


@pytest.mark.long
@pytest.mark.rates
def test_effects_outside_the_catalogue_get_no_name() -> None:
    """An alarm at the right joint; the one that the catalogue nearly describes is told apart in half of the cases."""
    verdicts, _ = verdicts_of(FOREIGN, range(8200, 8200 + FOREIGN_EACH))
    visible = [v for v in verdicts if v.seen >= VISIBLE]
    unlike = [v for v in visible if v.kind != LIKE_A_NAME]
    like = [v for v in verdicts if v.kind == LIKE_A_NAME]

    assert is_at_least(0.98, [v.detected for v in visible])
    assert is_at_most(0.05, [bool(v.false_names) for v in unlike])
    assert is_at_least(0.95, [v.joint_known for v in unlike])
    assert is_at_most(0.05, [bool(v.false_names) for v in verdicts])
    assert is_at_most(0.4, [bool(v.false_names) for v in like])


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize(("options", "rate", "count"), SOUND)
def test_sound_data_bring_in_no_name(options: dict[str, Any], rate: float, count: int) -> None:
    """From 100 to 500 poses, the first on arms with frames anywhere; elasticity is found where it is, and only there."""
    sizes = np.linspace(100, 500, count).astype(int)
    arms = [fresh(8300 + i) if options == {"masses": 0.03} else {} for i in range(count)]
    verdicts, _ = verdicts_on([("null", 8300 + i, arms[i] | {"n": int(n)} | options) for i, n in enumerate(sizes)])

    assert is_at_most(rate, [v.detected for v in verdicts])
    assert is_at_least(0.98, [v.sound for v in verdicts])


@pytest.mark.long
def test_on_few_rows_no_load_stands_for_a_bearing() -> None:
    """With 100 poses of a skew arm most bearings stay out of the model; what they do is no link that bends."""
    tasks = [("null", seed, fresh(seed) | {"n": 100}) for seed in (10110, 10118, 10123, 10131)]
    verdicts, _ = verdicts_on(tasks)

    assert not any(v.named for v in verdicts)


@pytest.mark.long
def test_on_few_rows_what_has_no_name_is_found() -> None:
    """134 rows for 46 parameters: chance explains the wave once in ten million searches."""
    verdict = judge(draw_case("other_wave", 81006, **fresh(81006)))

    assert verdict.right and not verdict.false_names, str(verdict)


@pytest.mark.long
@pytest.mark.rates
def test_what_can_not_be_seen_is_never_named() -> None:
    """Free lengths absorb the scale of an instrument: on no arm is a name given."""
    verdicts, _ = verdicts_of(["measurement_scale"], range(8400, 8410))

    assert not any(v.named for v in verdicts)
