"""The numbers by which poses show an effect or do not, and by which a found effect is explained:
each with its unit and origin.

Typical sizes of effects, and the shapes and orders that are tried, stand with the effects; the
thresholds by which a discovery accepts one in ``discover/policy.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_REST = "test_effect_numbers.py::test_a_joint_moves_by_a_tenth_of_a_milliradian"
_GRID = "test_effect_numbers.py::test_positions_are_distinct_by_a_thousandth_of_their_range"
_UNTRIED = "test_catalogue.py::test_what_can_not_be_tried_has_a_reason"
_ROUNDING = "test_model.py::test_a_bearing_that_feels_a_moment_of_rounding_is_not_made_of_rubber"
_SPRING = "test_catalogue.py::test_with_everything_recorded_nearly_everything_can_be_tried"
_PAYLOAD = "test_catalogue.py::test_a_wrong_payload_bends_the_drives"
_SHORT = "test_catalogue.py::test_elasticity_of_the_joints_takes_most_of_a_bent_link"
_LOOPS = "test_loops.py::test_names_of_parameters_are_those_that_loops_leave"
_PERIODIC = "test_effect_numbers.py::test_a_curve_over_nine_tenths_of_a_turn_is_periodic"
_PIECES = "test_effect_numbers.py::test_a_piece_of_a_curve_has_six_poses"
_BAND = "test_tones.py::test_the_second_wave_of_two_lobes_is_in_the_band"
_PAID = "test_tones.py::test_what_was_searched_for_is_paid_for"
_MULTIPLE = "test_tones.py::test_a_multiple_is_proposed_unless_chance_does_as_well"
_MAPS = "test_discovery_rates.py::test_sound_data_bring_in_no_name"
_FIELD = "test_smooth_field.py::test_a_field_has_the_covariance_of_its_lengths"
_FIELD_FOUND = "test_smooth_field.py::test_a_wave_that_is_part_of_a_field_becomes_one"
_CONSTANT = "test_catalogue.py::test_terms_without_a_name_are_effects_like_others"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class ShownNumbers:
    """By which the poses of a table show an effect."""

    close: float = number(1e-3, "ratio", _GRID,
        "of the distance of two positions to their range, below which they are equal",
        "encoder readings on a grid remain a grid")
    still: float = number(1e-4, "rad, m", _REST,
        "range of positions of a joint that stands still",
        "an encoder reads a resting joint to about 1e-5 rad, and drives settle to 9e-5 "
            "(Slamani 2012)")
    still_beside: float = number(1e-3, "ratio", _REST,
        "of this range to that of the joint that moves most, at most", "chosen")
    unfelt: float = number(1e-3, "ratio", _ROUNDING,
        "of a moment to the largest on the arm, below which it is not felt",
        "it is there only because the base is not quite level")
    unfelt_payload: float = number(1e-3, "ratio", _PAYLOAD,
        "of the moment of the payload about an axis to its largest, below which the axis is "
            "unaffected", "as for moments")
    constant: float = number(1e-9, "ratio", _UNTRIED,
        "of the variation of a basis to its size, below which it is constant", "rounding")
    constant_column: float = number(1e-6, "of the column", _CONSTANT,
        "variation up to which a recorded variable is constant", "chosen")
    spring: float = number(0.1, "ratio", _SPRING,
        "of the moment on a joint to the largest on the arm, below which a compensator is not "
            "looked for", "none would be built")
    short: float = number(1e-3, "m", _SHORT,
        "of a link, below which it does not bend and is no lever",
        "the rotation that shifts its end by hundredths of a millimetre would not be small")
    inert: float = number(1e-3, "1", _LOOPS,
        "motion of passive joints per unit of a coordinate of a rod, below which it is no "
            "parameter", "chosen")
    nearly_a_turn: float = number(0.9, "turns", _PERIODIC,
        "over which a curve of a drive is periodic",
        "the gap is too small for a Fourier series to oscillate in")
    poses_per_piece: int = number(6, "poses", _PIECES,
        "of each piece of a curve", "six positions show the size of a bump and its scatter")


@dataclass(frozen=True, kw_only=True)
class FieldNumbers:
    """A smooth function of two joints' positions, and those that are tried."""

    beyond: float = number(1.5, "lengths", _FIELD,
        "by which the domain of a smooth function reaches beyond the range on either side",
        "its sines are zero there; with 1.5 the covariance within the range is right to a tenth")
    faintest: float = number(4.5, "log variance", _FIELD,
        "of a sine below that of the slowest one, beyond which it is left out",
        "the sines left out have a hundredth of its variance")
    lengths: tuple[float, ...] = number((0.15, 0.25, 0.4), "ratio", _FIELD_FOUND,
        "of the lengths over which a function is alike to the range of each joint",
        "shorter ones a table of hundreds of poses does not resolve, longer ones are waves")
    shortest: float = number(0.02, "ratio",
        "test_smooth_field.py::test_a_field_is_no_finer_than_a_computer_holds",
        "of a length over which a function is alike to the range of its joint, below which a field "
            "is refused",
        "chosen: it has 2000 functions, and no table has as many poses a range")
    heights: tuple[float, ...] = number((3e-5, 6e-5, 1.2e-4, 2.4e-4, 4.8e-4), "rad", _FIELD_FOUND,
        "that a function may have (standard deviation)",
        "from what no one measures to 100 arcsec, by factors of 2")


@dataclass(frozen=True, kw_only=True)
class OriginNumbers:
    """By which a wave or a map is paid for, and a wave's order explained."""

    band: tuple[float, float] = number((20.0, 450.0), "cycles per revolution", _BAND,
        "between which waves of stages and encoders are looked for",
        "lower ones are curves of the drive, higher ones need ever more poses; two lobes of a "
            "strain wave gear of 1:101 make 202, and twice as many")
    finest: float = number(1e6, "cycles per revolution",
        "test_catalogue.py::test_an_order_is_one_that_a_joint_can_have",
        "of a wave, beyond which none is taken",
        "chosen: encoders have up to some 1e5 lines, and resolve no wave beyond 3e5")
    gain: float = number(18.0, "log likelihood", _PAID,
        "at which independent orders of a band are counted",
        "about what a wave selected in the whole band needs")
    by_chance: float = number(0.1, "probability", _MULTIPLE,
        "that an order matches by chance, above which no origin is suggested",
        "as a hint, one in ten is good enough")
    pairs: float = number(15.0, "pairs of joints", _MAPS,
        "of neighbours among which the likeliest maps are selected",
        "chosen: as many as a 6R arm has pairs of joints")


# fmt: on
SHOWN = ShownNumbers()
ORIGIN = OriginNumbers()
FIELD = FieldNumbers()
