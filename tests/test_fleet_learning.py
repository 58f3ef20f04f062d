"""A type is learned from information on its machines: right where the answer is known, safe with three, deaf to outliers."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import fleet_cases as cases
import jsonschema
import msgspec
import numpy as np
import polars as pl
import pytest
from fleet_cases import (
    OPTIONS,
    PRIOR,
    Family,
    machine_of,
    nominal_arm,
    real_machines,
    rows_of,
    sibling_of,
    siblings,
    table_of,
)
from scipy.stats import multivariate_normal as normal

from pincal import BadInputError, Robot, calibrate
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.information import RobotInformation
from pincal.errors import ModelFileError
from pincal.fleet.fleet_pages import _order
from pincal.fleet.machines import Machine, load_machines, save_machines
from pincal.fleet.robot_type import EVERYTHING, Learned, Membership, RobotType, calibrate_of_type, learn_type, load_type
from pincal.fleet.summary import AtTool, parameter_summary, strangers, type_lines
from pincal.model.conditions import Conditions
from pincal.schemas import schema_of


def learned(family: Family, count: int, seed: int = 1, **measured: float) -> tuple[Learned, np.ndarray, list[Machine]]:
    """Return a type, the truth and the machines that it was learned from."""
    rng = np.random.default_rng(seed)
    x = family.draw(count, rng)
    machines = [family.measured(one, rng, name=f"m{k}", **measured) for k, one in enumerate(x)]
    return learn_type(machines), x, machines


def test_machines_that_are_known_exactly_give_their_mean_and_covariance() -> None:
    """The closed form: with nothing but the machines' own spread, these are the sample's."""
    family = Family.drawn(np.random.default_rng(2), parameters=12, correlated=True)
    found, x, _ = learned(family, 1000, least=1e7, most=1e8)

    np.testing.assert_allclose(found.type.mean / PRIOR, x.mean(axis=0), atol=0.01 * x.std(axis=0).max())
    scale = np.outer(x.std(axis=0), x.std(axis=0))
    np.testing.assert_allclose(found.type.covariance / PRIOR**2 / scale, np.cov(x.T) / scale, atol=0.04)
    np.testing.assert_allclose(found.values / PRIOR, x, atol=0.01)


@pytest.mark.long
def test_mean_and_spread_are_right_where_half_of_the_directions_is_never_seen() -> None:
    """Within three standard errors, and what no machine shows stays at the prior."""
    family = Family.drawn(np.random.default_rng(3), parameters=30, unseen=12)
    found, _, _ = learned(family, 400)
    K, of = family.seen, found.type
    spread = np.sqrt(np.diag(K.T @ family.covariance @ K))

    off = K.T @ (of.mean / PRIOR - family.mean) / np.sqrt(np.diag(K.T @ of.mean_covariance @ K) / PRIOR**2)
    assert np.sqrt(np.mean(off**2)) < 1.4 and np.abs(off).max() < 4.0
    ratio = np.diag(K.T @ of.covariance @ K) / PRIOR**2 / spread**2
    assert np.abs(ratio - 1.0).max() < 3.5 * np.sqrt(2.0 / 400)
    unseen = np.eye(30) - K @ K.T
    np.testing.assert_allclose(of.seen, K @ K.T, atol=1e-6)
    prior = of.prior().dense_covariance() / PRIOR**2
    np.testing.assert_allclose(unseen @ prior @ unseen, unseen, atol=1e-6)


def test_order_and_names_of_machines_do_not_matter() -> None:
    """Nor does it matter which of two sites a machine is at: the same to 1e-9."""
    family = Family.drawn(np.random.default_rng(4), parameters=18, unseen=6)
    whole, _, machines = learned(family, 30)
    again = learn_type(replace(machine, name="") for machine in reversed(machines))

    for name in ("mean", "covariance", "mean_covariance"):
        np.testing.assert_allclose(getattr(again.type, name), getattr(whole.type, name), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(again.values[::-1], whole.values, rtol=1e-9, atol=1e-12)


def test_two_sites_learn_what_one_would(tmp_path: Path) -> None:
    """From their files alone, in which neither names nor labels need be."""
    family = Family.drawn(np.random.default_rng(5), parameters=18, unseen=6)
    whole, _, machines = learned(family, 12)
    machines[0] = replace(machines[0], labels={"hall": "north"})
    save_machines(tmp_path / "one.parquet", machines[:5])
    save_machines(tmp_path / "two.parquet", machines[5:], names=True)
    sent = load_machines([tmp_path / "one.parquet", tmp_path / "two.parquet"])
    found = learn_type(sent).type

    assert [machine.name for machine in sent[:5]] == [""] * 5 and sent[5].name == "m5" and not sent[0].labels
    for name in ("mean", "covariance", "mean_covariance", "spread_variance"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole.type, name), rtol=1e-9, atol=1e-18)
    assert (tmp_path / "one.parquet").stat().st_size < 5 * 8_000


def test_a_damaged_file_of_a_site_is_refused(tmp_path: Path) -> None:
    """Whatever bit is flipped, it is refused or read as it was written; so is a file of before checksums, unless damaged."""
    family = Family.drawn(np.random.default_rng(5), parameters=6)
    _, _, machines = learned(family, 3)
    path = tmp_path / "site.parquet"
    save_machines(path, machines, names=True)
    content = path.read_bytes()
    written = [(one.name, one.information.text()) for one in load_machines(path)]
    rng = np.random.default_rng(1)
    counted = Counter[str]()
    for bit in rng.choice(8 * len(content), 100, replace=False).tolist():
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = [(one.name, one.information.text()) for one in load_machines(path)]
            counted["same" if found == written else "other"] += 1
        except ModelFileError:
            counted["refused"] += 1
    assert counted["other"] == 0 and counted["refused"] > 50
    earlier = pl.read_parquet(content).drop("checksum")
    earlier.write_parquet(path)
    assert len(load_machines(path)) == 3
    pl.read_parquet(content).head(2).write_parquet(path)
    with pytest.raises(ModelFileError, match=r"damaged \(its rows have another checksum"):
        load_machines(path)


def test_readings_of_one_machine_add_up() -> None:
    """Two files of one name are one machine; its parts are what the whole is."""
    family = Family.drawn(np.random.default_rng(6), parameters=12)
    rng = np.random.default_rng(7)
    whole = []
    for k, x in enumerate(family.draw(6, rng)):
        J = rng.normal(size=(40, 12)) * 100.0
        r = J @ x + rng.normal(size=40)
        whole.append((J / PRIOR, r, f"m{k}"))
    one = learn_type(machine_of(family.parameters, *parts) for parts in whole)
    halves = [machine_of(family.parameters, J[i::2], r[i::2], name) for J, r, name in whole for i in (0, 1)]
    two = learn_type(halves)

    assert len(two.members) == two.type.machines == 6
    np.testing.assert_allclose(two.values, one.values, rtol=1e-6, atol=1e-12)


def test_no_machine_counts_twice() -> None:
    """The same file twice is there once; the same readings by two names, or by none, are refused."""
    family = Family.drawn(np.random.default_rng(6), parameters=12)
    whole, _, machines = learned(family, 4)
    again = learn_type([*machines, machines[1]])
    np.testing.assert_array_equal(again.type.covariance, whole.type.covariance)
    for name in ("copy", ""):
        with pytest.raises(BadInputError, match="same readings as machine 'm1'"):
            learn_type([*machines, replace(machines[1], name=name)])


@pytest.mark.long
def test_a_parameter_that_some_machines_lack_is_learned_from_the_others() -> None:
    """And a machine without it takes part with all that it has."""
    family = Family.drawn(np.random.default_rng(8), parameters=12)
    whole, _, machines = learned(family, 400)
    without = [m if k % 2 else _without(m, 0) for k, m in enumerate(machines)]
    found = learn_type(without).type
    at = [found.names.index(name) for name in whole.type.names]

    assert set(found.names) == set(whole.type.names)
    ratio = found.covariance[at, at] / np.diag(whole.type.covariance)
    assert 0.7 < ratio[0] < 1.4 and np.abs(ratio[1:] - 1.0).max() < 0.25


def _log_ratio(of: RobotType, family: Family) -> np.ndarray:
    """Return the logarithm of learned over true variances, shape (P,)."""
    return np.log(np.diag(of.covariance) / PRIOR**2 / np.diag(family.covariance))


def _without(machine: Machine, place: int) -> Machine:
    own = machine.information
    form = own.form.released(np.array([place])).held(np.array([place]))
    return replace(machine, information=RobotInformation.of_form(form, own.robot, own.geometry, own.known))


@pytest.mark.long
def test_machines_that_were_hit_do_not_spoil_the_type_and_are_named() -> None:
    """One in twenty has a joint off by half a millimetre or half a milliradian and more: spread and mean stay."""
    family = Family.drawn(np.random.default_rng(9))
    rng = np.random.default_rng(10)
    x, element = family.draw(240, rng), np.arange(40) // 6
    hit = np.arange(0, 240, 20)
    joints = rng.integers(0, 6, len(hit))
    for k, joint in zip(hit, joints, strict=True):
        x[k, element == joint] += np.array([-1.0, 1.0])[rng.integers(0, 2, 6)] * rng.uniform(0.2, 1.0, 6)
    found = learn_type(family.measured(one, rng, name=f"m{k}") for k, one in enumerate(x))
    apart = {k for k, member in enumerate(found.members) if member.off}

    off = _log_ratio(found.type, family) / np.sqrt(found.type.spread_variance)
    assert np.sqrt(np.mean(off**2)) < 1.4 and np.abs(off).max() < 4.0
    assert apart == set(hit.tolist())
    assert all(f"joint_{joint + 1}" in found.members[k].off for k, joint in zip(hit, joints, strict=True))
    assert all(found.members[k].p_value < 1e-4 for k in hit)
    assert 0.02 < found.type.hit < 0.09


@pytest.mark.parametrize("count", [10, 20])
def test_a_machine_that_was_hit_hard_is_named_among_few(count: int) -> None:
    """However far it is off: its distance was once taken for a wide spread of all."""
    family = Family.drawn(np.random.default_rng(31), parameters=24)
    rng = np.random.default_rng(32)
    x = family.draw(count, rng)
    k = int(np.argsort(np.diag(family.root))[12])
    x[0, k] += 3.0
    found = learn_type(family.measured(one, rng, least=1e4, most=1e6, name=f"m{i}") for i, one in enumerate(x))

    assert [member.machine for member in found.members if member.off] == ["m0"]
    assert np.sqrt(found.type.covariance[k, k]) / PRIOR < 3.0 * family.root[k, k]


@pytest.mark.long
@pytest.mark.rates
def test_machines_without_correlations_hardly_show_any() -> None:
    """Of twenty families without any, twenty machines each show some in at most four, by chance."""
    count = 0
    for seed in range(20):
        family = Family.drawn(np.random.default_rng(seed), parameters=12)
        covariance = learned(family, 20, seed, least=1e4, most=1e5)[0].type.covariance
        count += np.count_nonzero(covariance) > 12

    assert count <= 4


@pytest.mark.parametrize(("information", "rank"), [(0.9, 0), (1.2, 1)])
def test_a_direction_counts_if_a_machine_knows_it_better_than_the_prior(information: float, rank: int) -> None:
    """Information 1 in units of the prior is as much as it tells itself."""
    family = Family.drawn(np.random.default_rng(2), parameters=12)
    row = np.eye(12)[:1] * np.sqrt(information) / PRIOR
    of = learn_type([machine_of(family.parameters, row, np.zeros(1))]).type

    assert np.trace(of.seen) == pytest.approx(rank)


def test_one_machine_in_fifty_may_always_be_unusual() -> None:
    """So a machine of which nothing is known is like the others with a probability of 0.98, if hardly any was hit."""
    family = Family.drawn(np.random.default_rng(2), parameters=12)
    of = learned(family, 60)[0].type
    nothing = machine_of(family.parameters, np.eye(12)[:1] * 1e-9 / PRIOR, np.zeros(1))

    assert of.hit < 0.02
    assert of.judge(nothing).probability == pytest.approx(0.98)


@pytest.mark.parametrize("spread_variance", [0.0, pytest.param(10.0, marks=pytest.mark.long)])
def test_a_machine_is_unusual_if_both_its_odds_and_its_p_value_say_so(spread_variance: float) -> None:
    """Likelier unlike the others than like them, and below a p-value of 0.05: that is large if their spread is uncertain."""
    family = Family.drawn(np.random.default_rng(18), parameters=18)
    of = msgspec.structs.replace(learned(family, 30)[0].type, spread_variance=np.full(18, spread_variance))
    x = family.draw(1, np.random.default_rng(19))[0]
    members = []
    for size in np.linspace(0.0, 1.0, 150):
        y = x.copy()
        y[6:12] += size
        members.append(of.judge(family.measured(y, np.random.default_rng(20))))

    assert [bool(one.off) for one in members] == [one.probability < 0.5 and one.p_value < 0.05 for one in members]
    assert any(one.off for one in members)
    assert any(one.probability < 0.5 and not one.off for one in members) == (spread_variance > 0.0)


def test_elements_of_a_tenth_of_the_odds_are_named() -> None:
    """By the densities of what readings say, where a joint, or everything, deviates by as much as priors allow."""
    family = Family.drawn(np.random.default_rng(18), parameters=18)
    of = learned(family, 30)[0].type
    prior, x = of.prior(), family.draw(1, np.random.default_rng(19))[0]
    elements = np.arange(18) // 6
    kinds = {f"joint_{joint + 1}": elements == joint for joint in range(3)} | {EVERYTHING: elements >= 0}
    several = 0
    for size in np.linspace(0.0, 0.3, 60):
        y = x + np.array([0.4, size, 0.0])[elements]
        machine = family.measured(y, np.random.default_rng(20))
        form = machine.information.form
        C = np.linalg.inv(form.H)
        density = {
            name: normal(prior.values, prior.dense_covariance() + C + PRIOR**2 * np.diag(at * 1.0)).logpdf(C @ form.g)
            for name, at in kinds.items()
        }
        odds = np.exp(np.array(list(density.values())) - max(density.values()))
        expected = tuple(np.array(list(density))[odds > 0.1 * odds.sum()].tolist())
        several += len(expected) > 1
        assert of.judge(machine).off == expected

    assert several > 3


@pytest.mark.long
def test_a_prior_is_widened_by_a_quarter_or_not_at_all() -> None:
    """The variances of a machine are those of its type, or more than 1.25 times as large."""
    family = Family.drawn(np.random.default_rng(11), parameters=18, unseen=6)
    of, rng = learned(family, 100)[0].type, np.random.default_rng(12)
    times = np.array([of.judge(family.measured(x, rng)).times for x in family.draw(150, rng)])

    assert np.all((times == 1.0) | (times > 1.25)) and np.any((times > 1.25) & (times < 1.35))


def test_strangers_are_counted_over_all_machines() -> None:
    """A single machine at p = 0.049 is one; among two the first has to be below 0.025 (Holm)."""

    def named(*p_values: float) -> list[str]:
        members = [Membership(f"m{k}", p, 0.1, ("joint_1",)) for k, p in enumerate(p_values)]
        return [member.machine for member, _ in strangers(members)]

    assert named(0.049) == ["m0"] and not named(0.051)
    assert named(0.049, 0.024) == ["m1", "m0"] and not named(0.049, 0.026)


@pytest.mark.parametrize(("sigmas", "count"), [(1.95, 0), (1.97, 1)])
def test_errors_of_a_data_sheet_are_significant_beyond_two_sigma(sigmas: float, count: int) -> None:
    """One parameter that is off by 1.96 standard deviations is one in twenty."""
    found, _, _ = learned(Family.drawn(np.random.default_rng(2), parameters=1), 20)
    of = msgspec.structs.replace(found.type, mean=sigmas * np.sqrt(np.diag(found.type.mean_covariance)))
    lines = list(type_lines(replace(found, type=of), AtTool(0.0, {}, np.zeros(1), 0.0, 0.0, {})))

    assert any(f"significantly in {count} of 1 parameters" in line for line in lines)


@pytest.mark.parametrize(("share", "is_shown"), [(0.04, False), (0.06, True)])
def test_numbers_stand_only_beside_what_readings_tell(share: float, is_shown: bool) -> None:
    """A parameter of which readings tell less than a twentieth is a matter of convention."""
    of = learned(Family.drawn(np.random.default_rng(2), parameters=2), 20)[0].type
    direction = np.array([np.sqrt(share), np.sqrt(1.0 - share)])
    of = msgspec.structs.replace(of, seen=np.outer(direction, direction))
    first = parameter_summary(of).rows[0]

    assert first[-1] == pytest.approx(share) and (first[2] is not None) == is_shown


@pytest.mark.parametrize(("share", "is_drawn"), [(0.29, False), (0.31, True)])
def test_parameters_are_drawn_of_which_readings_tell_a_third(share: float, is_drawn: bool) -> None:
    """Of two lengths that are told apart in one direction only."""
    found, _, _ = learned(Family.drawn(np.random.default_rng(2), parameters=4), 20)
    of = found.type
    lengths = [k for k, parameter in enumerate(of.parameters) if parameter.unit == "m"]
    direction = np.zeros(4)
    direction[lengths] = np.sqrt(share), np.sqrt(1.0 - share)
    of = msgspec.structs.replace(of, seen=np.outer(direction, direction))

    assert sorted(_order(replace(found, type=of), None, "m").tolist()) == (lengths if is_drawn else lengths[1:])


@pytest.mark.long
def test_p_values_of_machines_of_the_type_are_uniform_or_larger() -> None:
    """Of 250 further machines."""
    family = Family.drawn(np.random.default_rng(11), parameters=18, unseen=6)
    of, rng = learned(family, 100)[0].type, np.random.default_rng(12)
    p = np.array([of.judge(family.measured(x, rng)).p_value for x in family.draw(250, rng)])

    for alpha in (0.01, 0.05, 0.2):
        assert np.mean(p < alpha) < alpha + 3.0 * np.sqrt(alpha * (1.0 - alpha) / 250)


@pytest.mark.long
@pytest.mark.parametrize("count", [3, *(pytest.param(count, marks=pytest.mark.rates) for count in (1, 10))])
def test_few_machines_give_a_prior_that_covers(count: int) -> None:
    """Over families: intervals of 95 % hold 92 to 99 % of further machines, along what is seen."""
    rng, inside = np.random.default_rng(13), []
    for seed in range(16):
        family = Family.drawn(np.random.default_rng(seed), parameters=18, unseen=6)
        prior = learned(family, count, seed)[0].type.prior()
        K, covariance = family.seen, prior.dense_covariance() / PRIOR**2
        off = (family.draw(50, rng) - prior.values / PRIOR) @ K / np.sqrt(np.diag(K.T @ covariance @ K))
        inside.append(np.mean(np.abs(off) < 1.96))

    assert 0.92 < np.mean(inside) < 0.99


def test_a_file_holds_a_type_to_the_last_digit(tmp_path: Path) -> None:
    """And nothing else can be read as one."""
    family = Family.drawn(np.random.default_rng(14), parameters=12)
    of = learned(family, 8)[0].type
    of.save(tmp_path / "type.json", provenance={"version": "0"})
    again = load_type(tmp_path / "type.json")
    jsonschema.validate(json.loads((tmp_path / "type.json").read_text()), schema_of("type"))

    assert again.parameters == of.parameters and again.machines == 8
    for name in ("mean", "covariance", "mean_covariance", "seen"):
        np.testing.assert_array_equal(getattr(again, name), getattr(of, name))
    text = (tmp_path / "type.json").read_text()
    for old, new in (('"robot": "arm"', '"robot": null'), ('"hit": ', '"hit": 2'), ('"mean": [', '"mean": [1, ')):
        (tmp_path / "bad.json").write_text(text.replace(old, new))
        with pytest.raises(ModelFileError, match="type"):
            load_type(tmp_path / "bad.json")


@cache
def of_eight() -> RobotType:
    """Return a type that was learned from eight machines."""
    return learned(Family.drawn(np.random.default_rng(14), parameters=12), 8)[0].type


@pytest.mark.parametrize(
    ("name", "places", "value", "words"),
    [
        ("covariance", ([0, 1], [1, 0]), 1.0, "is not a covariance"),
        ("covariance", ([0], [1]), 1e-6, "is not a covariance"),
        ("mean_covariance", ([0], [0]), 1e6, "is not a covariance"),
        ("seen", ([0], [0]), 2.0, "is not a projection matrix"),
        ("mean", ([2],), 1e300, "invalid numbers"),
        ("mean", ([2],), 1010.0 * PRIOR, "invalid numbers"),
        ("mean", ([2],), np.nan, "finite"),
        ("spread_variance", ([2],), -0.1, "invalid numbers"),
        ("priors", ([2],), 1e-30, "invalid numbers"),
    ],
)
def test_a_type_that_was_edited_by_hand_is_refused(
    name: str, places: tuple[list[int], ...], value: float, words: str, tmp_path: Path
) -> None:
    """By the name of what can't be: no machine could be drawn from it, and the fits by it were wrong or crashed."""
    of = of_eight()
    of.save(tmp_path / "type.json", provenance={})
    entries = json.loads((tmp_path / "type.json").read_text())
    array = np.array(getattr(of, name))
    array[places] = value
    (tmp_path / "type.json").write_text(json.dumps({**entries, name: array.tolist()}))

    with pytest.raises(ModelFileError, match=words):
        load_type(tmp_path / "type.json")
    (tmp_path / "type.json").write_text(json.dumps({**entries, "entries": [entries["entries"][0]] * 12}))
    with pytest.raises(ModelFileError, match="twice"):
        load_type(tmp_path / "type.json")


def test_what_is_not_of_one_type_is_refused(tmp_path: Path) -> None:
    """Another nominal geometry, other units, no machine, and damaged files."""
    family = Family.drawn(np.random.default_rng(15), parameters=12)
    found, _, machines = learned(family, 3)
    other = replace(machines[0], name="other", information=msgspec.structs.replace(machines[0].information, geometry=2))
    with pytest.raises(BadInputError, match="different nominal geometries"):
        learn_type([*machines, other])
    with pytest.raises(BadInputError, match="a different nominal geometry"):
        found.type.judge(other)
    with pytest.raises(BadInputError, match="one or more"):
        learn_type([])
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    with pytest.raises(ModelFileError, match="can't be read"):
        load_machines(tmp_path / "bad.parquet")


@pytest.mark.long
def test_real_siblings_save_poses(shared_data: Path) -> None:
    """Three UR3e as their maker measured them: a fourth needs fewer poses, and no more at 25."""
    robot = nominal_arm("ur3e")
    siblings = {name: machine for kind, name, machine in real_machines() if kind == "ur3e"}
    known = {name: sibling_of(robot, m, name, poses=60, seed=k) for k, (name, m) in enumerate(siblings.items())}
    ratios: dict[int, list[tuple[float, float]]] = {8: [], 25: []}
    for name, machine in siblings.items():
        of = learn_type(m for other, m in known.items() if other != name).type
        truth = table_of(robot, machine, 300, 1000, noise=0.0)
        for poses, errors in ratios.items():
            for seed in range(2):
                table = table_of(robot, machine, poses, seed)
                alone, (with_type, _) = calibrate(robot, table, OPTIONS), calibrate_of_type(robot, table, of, OPTIONS)
                errors.append((cases.error_of(alone, truth), cases.error_of(with_type, truth)))

    alone, with_type = np.mean(ratios[8], axis=0)
    assert alone > 0.4 and with_type < 0.45 * alone
    alone, with_type = np.mean(ratios[25], axis=0)
    assert with_type < 1.02 * alone


@pytest.mark.long
def test_a_target_on_parallel_axes_stays_within_reach() -> None:
    """Of a SCARA its height is told by tilts alone: the surer these are small, the farther off it went, up to kilometres."""
    text = '<robot name="scara"><link name="l0"/>'
    for k, (x, kind, low, high) in enumerate(((0.0, "revolute", -2.3, 2.3), (0.35, "revolute", -2.3, 2.3),
                                              (0.25, "prismatic", -0.2, 0.0), (0.0, "revolute", -3.0, 3.0)), 1):  # fmt: skip
        text += f'<link name="l{k}"/><joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/>'
        text += f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/><limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
        text += "</joint>"
    arm, nominal = Robot.from_urdf((text + "</robot>").encode()), sim.TrueMachine.from_urdf(text + "</robot>", tip="l4")
    rng = np.random.default_rng(41)
    machines = [nominal.draw_errors(rng, sigma_length=2e-4, sigma_angle=2e-4, sigma_offset=2e-4) for _ in range(14)]
    of = learn_type(sibling_of(arm, m, f"m{k}", poses=40, seed=k) for k, m in enumerate(machines[:8])).type
    heights, inside = [], []
    for k, machine in enumerate(machines[8:]):
        fit, _ = calibrate_of_type(arm, table_of(arm, machine, 6, 90 + k), of, OPTIONS)
        truth = table_of(arm, machine, 50, 190 + k, noise=0.0)
        off = fit.predict(truth.q)[:, :, 3] - truth.position
        inside.append(np.mean(np.abs(off) < 1.96 * fit.position_sigma(Conditions.at(truth.q))))
        heights.append(abs(fit.values[[p.name for p in fit.problem.parameters].index("tool.z")]))

    assert max(heights) < 2.0 and np.mean(inside) > 0.88


@pytest.mark.long
def test_a_machine_far_from_its_type_is_no_noise() -> None:
    """Twelve poses of one that is twenty times as far off: found out, and calibrated as well as without a type."""
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    of = learn_type(
        Machine.of(calibrate(robot, rows_of(robot, m, 30, k), OPTIONS).fit, str(k)) for k, m in enumerate(siblings(3))
    )
    nominal = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    machine = nominal.draw_errors(np.random.default_rng(2), sigma_length=5e-3, sigma_angle=5e-3)
    table, truth = rows_of(robot, machine, 12, 7), rows_of(robot, machine, 100, 8)
    alone, (fit, member) = calibrate(robot, table, OPTIONS), calibrate_of_type(robot, table, of.type, OPTIONS)

    assert member.off and member.p_value < 1e-3
    assert cases.error_of(fit, truth) < 1.5 * cases.error_of(alone, truth)


def test_a_machine_of_another_kind_gets_its_wide_prior_back() -> None:
    """All of its elements, or the one in which it differs."""
    family = Family.drawn(np.random.default_rng(16), parameters=24)
    of, rng = learned(family, 20)[0].type, np.random.default_rng(17)
    x = family.draw(1, rng)[0]
    bent, strange = x.copy(), x + 0.7 * rng.normal(size=24)
    bent[6:12] += 0.5

    assert not of.judge(family.measured(x, rng)).off
    assert of.judge(family.measured(bent, rng)).off == ("joint_2",)
    assert of.judge(family.measured(strange, rng)).off == (EVERYTHING,)
    narrow, wide = of.prior().sigma, of.prior(member=Membership("", 0.0, 0.0, ("joint_2",))).sigma
    np.testing.assert_allclose(wide[6:12] ** 2, narrow[6:12] ** 2 + PRIOR**2)
    np.testing.assert_allclose(wide[12:], narrow[12:])
    assert isinstance(of, RobotType)
