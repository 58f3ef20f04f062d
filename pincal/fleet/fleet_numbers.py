"""The thresholds by which machines of a type and changes in a fleet are named, and files refused,
each with its unit and origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number

_CHECKS = "test_fleet_checks.py::"
_LEARNING = "test_fleet_learning.py::"
_INTERIM = "test_interim.py::"
_KINDS = _CHECKS + "test_what_is_believed_of_a_change_beforehand"
_UNUSUAL = _LEARNING + "test_a_machine_is_unusual_if_both_its_odds_and_its_p_value_say_so"


@dataclass(frozen=True, kw_only=True)
class TypeNumbers:
    """Thresholds on a type of robot and its machines."""

    by_chance: float = number(
        1.0,
        "standard errors",
        _LEARNING + "test_machines_without_correlations_hardly_show_any",
        "by which the mean square of correlations has to exceed that of independent parameters "
        "before a type has any",
        "chosen: correlations that are left out cost little, false ones mislead a calibration",
    )
    median: float = number(
        3.0,
        "log likelihood",
        _LEARNING + "test_a_machine_that_was_hit_hard_is_named_among_few",
        "by which a population that begins at medians of the machines has to be likelier than "
        "one that begins at their means to be taken",
        "odds of 20 to 1",
    )
    determined: float = number(
        0.5,
        "machines",
        _LEARNING + "test_a_direction_counts_if_a_machine_knows_it_better_than_the_prior",
        "that have to determine a direction, for the type to hold along it; else the prior does",
        "one machine that knows it as well as the prior",
    )
    least_hit: float = number(
        0.02,
        "probability",
        _LEARNING + "test_one_machine_in_fifty_may_always_be_unusual",
        "beforehand that a machine is unusual, at least, however few of its type were",
        "chosen: the share that is assumed where no machine is known",
    )
    unlikely: float = number(
        0.5,
        "probability",
        _UNUSUAL,
        "of being like the others, below which a machine is unusual",
        "it is then likelier to be",
    )
    unusual: float = number(
        0.05,
        "probability",
        _UNUSUAL,
        "that a machine of the type deviates as much, below which it is unusual",
        "usual: it guards against a spread that few machines underestimate",
    )
    share: float = number(
        0.1,
        "probability",
        _LEARNING + "test_elements_of_a_tenth_of_the_odds_are_named",
        "that an unusual machine deviates in an element, above which the element is named",
        "chosen: its prior is to be widened wherever the deviation may be",
    )
    farther: float = number(
        1.25,
        "ratio",
        _LEARNING + "test_a_prior_is_widened_by_a_quarter_or_not_at_all",
        "of the variances of a machine to those of its type, above which its prior is wider",
        "chosen: 12 % in a standard deviation matter to nobody",
    )
    fits: float = number(
        2.0,
        "ratio",
        _LEARNING + "test_a_machine_far_from_its_type_is_no_noise",
        "of the squares of residuals to the declared noise's, above which a fit with the type's "
        "prior disagrees with it and the machine is judged without",
        "chosen",
    )
    absurd: float = number(
        1e3,
        "sizes of priors",
        _LEARNING + "test_a_type_that_was_edited_by_hand_is_refused",
        "of a mean or a standard deviation, above which the file of a type is refused",
        "chosen: metres and radians, which no machine of a type is off by",
    )
    among_all: float = number(
        0.05,
        "probability",
        _LEARNING + "test_strangers_are_counted_over_all_machines",
        "that any machine of a sound fleet is listed as unlike the others",
        "usual",
    )
    data_sheet: float = number(
        0.05,
        "probability",
        _LEARNING + "test_errors_of_a_data_sheet_are_significant_beyond_two_sigma",
        "that any parameter of a correct data sheet is reported as off",
        "usual",
    )
    told: float = number(
        0.05,
        "ratio",
        _LEARNING + "test_numbers_stand_only_beside_what_readings_tell",
        "of a parameter that readings have to determine for its numbers to be shown",
        "chosen: the rest of it is a matter of convention",
    )
    drawn: float = number(
        0.3,
        "ratio",
        _LEARNING + "test_parameters_are_drawn_of_which_readings_tell_a_third",
        "of a parameter that readings determine, above which it is drawn",
        "chosen: the rest of it is a matter of convention",
    )


@dataclass(frozen=True, kw_only=True)
class WatchNumbers:
    """Thresholds on changes in a fleet over time, and what is believed of them beforehand."""

    false_discoveries: float = number(
        0.05,
        "ratio",
        _CHECKS + "test_one_alarm_needs_as_much_evidence_as_there_are_robots",
        "of false alarms to all, at most, in the long run",
        "usual",
    )
    hazard: float = number(
        0.005,
        "probability",
        _CHECKS + "test_one_diagnosis_weighs_as_its_e_value",
        "beforehand that a robot, or a group, changes before a round",
        "chosen: every fourth year of weekly rounds; a factor of two costs 0.7 of log evidence",
    )
    one: float = number(
        0.6,
        "probability",
        _KINDS,
        "beforehand that a change is of one parameter",
        "chosen: the simplest is the likeliest",
    )
    element: float = number(
        0.3, "probability", _KINDS, "beforehand that it is of one element (joint)", "chosen"
    )
    everything: float = number(
        0.1, "probability", _KINDS, "beforehand that it is of everything", "chosen"
    )
    fewest: int = number(
        5,
        "robots",
        _CHECKS + "test_five_robots_are_a_group_that_drifts",
        "of a group, below which it does not drift but its robots change",
        "chosen: fewer robots may have changed independently",
    )
    equal: float = number(
        log(100.0),
        "log evidence",
        _CHECKS + "test_explanations_within_odds_of_a_hundred_are_named",
        "up to which other explanations of a change are named, too",
        "odds of 100 to 1",
    )
    watched: float = number(
        0.05,
        "probability",
        _CHECKS + "test_adjusted_p_values_below_a_twentieth_are_to_be_watched",
        "adjusted for a round, below which a robot that is not reported is to be watched",
        "usual",
    )


@dataclass(frozen=True, kw_only=True)
class InterimNumbers:
    """Thresholds on interim checks of one robot."""

    false_alarms: float = number(
        0.05,
        "probability",
        _INTERIM + "test_an_alarm_needs_evidence_of_the_inverse_of_its_rate",
        "of any alarm over the whole life of a robot that has not changed",
        "usual",
    )
    fewest: int = number(
        3,
        "stops",
        _INTERIM + "test_two_points_are_refused",
        "of a check, below which it is refused",
        "three points give the place of a body",
    )


TYPES = TypeNumbers()
WATCH = WatchNumbers()
INTERIM = InterimNumbers()
