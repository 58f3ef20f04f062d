"""Numbers by which a table is taken to be of its robot, and mistakes in it are named."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from pincal.thresholds import number

_MISTAKEN = "test_agreement.py::test_what_is_wrong_with_a_table_is_named"
_INCURABLE = "test_agreement.py::test_what_nothing_cures_is_not_to_be_used"
_REAL = "test_agreement.py::test_real_tables"
_ZEROS = "test_zeros.py::test_what_differs_from_the_urdf_is_found_and_named"
_KNOWN_ZEROS = "test_zeros.py::test_unknown_zeros_have_no_prior"


@dataclass(frozen=True, kw_only=True)
class AgreementNumbers:
    """Thresholds by which a table is refused as not of its robot, and mistakes in it are named."""

    suspicious: float = number(
        0.01,
        "ratio",
        _MISTAKEN,
        "of the error of the nominal robot to its reach, above which mistakes are searched for",
        "real robots have a fifth of it or less",
    )
    hopeless: float = number(
        0.2,
        "ratio",
        _INCURABLE,
        "of the error of the nominal robot to its reach, above which no geometric error "
        "explains the table",
        "chosen",
    )
    implausible: float = number(
        0.002,
        "ratio",
        _INCURABLE,
        "of residuals of a calibration to the reach, that no real arm has",
        "real arms have a tenth of it, an elastic one with the rigid model less than half",
    )
    implausible_m: float = number(
        0.0015, "m", _INCURABLE, "residuals that no real arm has, at least", "the same arms"
    )
    implausible_rad: float = number(
        0.02, "rad", _INCURABLE, "residual orientations that no real arm has", "the same arms"
    )
    given_length: float = number(
        1e-5,
        "probability",
        "test_named_points.py::test_a_wrong_distance_between_sockets_is_named",
        "that a right distance is as far from what readings and the arm's lengths say, below which "
        "it is doubted",
        "one in a hundred thousand calibrations",
    )
    noisy: float = number(
        5.0,
        "ratio",
        "test_agreement.py::test_a_noisy_instrument_may_be_declared_in_the_table",
        "of residuals to a declared noise, up to which they are plausible however large",
        "one in two million by chance",
    )
    computed: float = number(
        2e-6,
        "m",
        _REAL,
        "typical error below which positions are computed from the joints, and rounded",
        "instruments are ten times worse",
    )
    cured: float = number(
        4.0,
        "ratio",
        _MISTAKEN,
        "by which undoing a mistake has to reduce the error before it is named",
        "chosen",
    )
    chance: float = number(
        1e-4,
        "probability",
        "test_mistakes.py::test_a_sound_table_of_few_poses_is_not_accused",
        "that any of all hypotheses that are tried leaves as little by chance, below which one is "
        "named",
        "a thousand sound tables, each with its own search, are then refused once in ten thousand",
    )
    turned: float = number(
        0.06,
        "rad",
        "test_mistakes.py::test_a_reading_of_orientations_is_told_from_all_others",
        "of orientations of the robot as described, up to which a reading of them explains them",
        "three times what calibrated arms may have, as large as a zero that is not looked for",
    )
    senseless: float = number(
        0.3,
        "rad",
        "test_mistakes.py::test_orientations_of_nothing_are_refused",
        "that orientations alone leave, above which they are refused though nothing explains them",
        "fifteen times what no real arm has",
    )
    rival: float = number(
        2.0,
        "ratio",
        _MISTAKEN,
        "of the residuals of another correction to those of the best, below which it is as likely",
        "chosen",
    )
    alike: float = number(
        1.2,
        "ratio",
        _ZEROS,
        "of the residuals of shifted zeros to the least, below which the smallest shifts are taken",
        "chosen",
    )
    shift: float = number(
        radians(2.0), "rad", _ZEROS, "above which the error of a zero is named", "chosen"
    )
    slight: float = number(
        0.01, "rad", _ZEROS, "above which errors of other zeros are corrected with it", "chosen"
    )
    unknown: float = number(
        1.0, "rad", _KNOWN_ZEROS, "prior of a zero above which it counts as unknown", "chosen"
    )
    improved: float = number(
        1.5,
        "ratio",
        _ZEROS,
        "by which shifted zeros have to reduce the residuals of a calibration",
        "a third of them",
    )
    no_worse: float = number(
        1.1,
        "ratio",
        _ZEROS,
        "by which they may increase them where the data have pulled a zero far from its prior",
        "chosen",
    )
    pulled: float = number(
        1.2,
        "ratio",
        _ZEROS,
        "of a zero to its prior, from which on data have pulled it far",
        "chosen",
    )
    usual: float = number(
        0.1,
        "ratio",
        _REAL,
        "of residuals to those that no arm has, up to which they are those of real arms",
        "these have a tenth",
    )
    telling: float = number(
        2.0,
        "ratio",
        "test_agreement.py::test_the_table_of_another_robot_is_told",
        "of what a calibration corrects to its allowed residuals, above which it distinguishes "
        "robots",
        "chosen",
    )


AGREEMENT = AgreementNumbers()
