"""Numbers of the remainder: what is smooth in the joints and has no name."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_REMAINDER = "test_remainder.py::test_a_smooth_error_of_all_joints_is_predicted"
_WORSE = "test_remainder.py::test_a_region_that_is_worse_refuses_it"
_SOUND_REMAINDER = "test_remainder.py::test_noise_has_no_remainder"


@dataclass(frozen=True, kw_only=True)
class RemainderNumbers:
    """What is smooth in the joints and has no name."""

    lengths: tuple[float, ...] = number(
        (0.25, 0.5, 1.0, 2.0, 4.0),
        "rad",
        _REMAINDER,
        "over which errors may be alike",
        "chosen: shorter ones are drive curves, longer ones are geometry",
    )
    sizes: tuple[float, ...] = number(
        (1e-5, 2e-5, 4e-5, 8e-5, 1.6e-4, 3.2e-4, 6.4e-4),
        "rad or m",
        _REMAINDER,
        "that errors of drives, and displacements, may have",
        "from what no one measures to 2 arcmin, by factors of 2",
    )
    together: int = number(
        2,
        "joints",
        _REMAINDER,
        "on which each part of an error depends",
        "as functions of all joints no table of hundreds of poses resolves them; on a real UR5 "
        "the evidence was exp(88) for pairs of joints against all of them",
    )
    waves: int = number(
        2,
        "waves",
        _REMAINDER,
        "of each pair of joints",
        "chosen: with six drives 360 amplitudes, of which readings tell some dozens; twice as many "
        "waves predicted no better in as many sums, and lengthen the file",
    )
    rows: int = number(
        400,
        "rows",
        _REMAINDER,
        "of which the likelihood is computed",
        "chosen: two sizes and two lengths need no more",
    )
    tried_together: int = number(
        2,
        "lengths",
        _REMAINDER,
        "of each kind that are tried with those of the other kind",
        "chosen: only the time depends on it",
    )
    tried: int = number(
        3,
        "remainders",
        _REMAINDER,
        "that are fitted at most, the likeliest ones, until regions that are left out are "
        "predicted better",
        "chosen: only the time depends on it",
    )
    noise: tuple[float, float] = number(
        (0.05, 1.2),
        "ratio",
        _REMAINDER,
        "least and largest variance of the noise beside a remainder, to that without",
        "chosen: a remainder that explains 95 % of the squares is a missing name",
    )
    noises: int = number(
        30,
        "variances",
        _REMAINDER,
        "between these two that are tried",
        "chosen: steps of a tenth",
    )
    told: float = number(
        0.3,
        "ratio",
        _REMAINDER,
        "information of all rows on a direction of the amplitudes, to that of its prior, at least",
        "chosen: the variance of what is left out would be a quarter smaller at most",
    )
    most: int = number(
        96,
        "amplitudes",
        _REMAINDER,
        "at most, those of which readings tell most",
        "chosen: at new poses of an arm displaced by .25 mm .164 mm are left with 64, .144 with "
        "96, .139 with 128, whose file is half as large again",
    )
    digits: int = number(
        4,
        "digits",
        _REMAINDER,
        "behind the point, of a wave's part in a sum",
        "chosen: the file is shorter, and the sums are what the file says",
    )
    evidence: float = number(
        4.6,
        "log odds",
        _SOUND_REMAINDER,
        "in favour of a remainder, at least",
        "100 to 1, as for a name",
    )
    region: int = number(
        10,
        "rows",
        _WORSE,
        "of a region that is left out, at least, that its mean error counts; one of fewer rows is "
        "one with its neighbour",
        "chosen: of fewer the mean is not known to a sixth",
    )
    worse: float = number(
        0.05,
        "probability",
        "test_names_by_region.py::test_what_is_beyond_scatter_is_a_doubt",
        "that names predict any of the regions that are left out as much worse than geometry and "
        "elasticity by chance, below which they are doubted",
        "as for any doubt; of 24 drawn tables with a true name none came below",
    )
    judged: int = number(
        3000,
        "rows",
        "test_remainder.py::test_of_many_rows_some_are_judged_first",
        "of which remainders are judged; what passes is judged by all rows again",
        "chosen: with 120 a region means are known to a twentieth, and a fit takes seconds",
    )
    regions: int = number(
        4,
        "regions",
        "test_remainder.py::test_few_poses_have_none",
        "of so many rows, at least, that may tell whether something is predicted better",
        "chosen: the scatter of their gains is known to a half",
    )
    narrower: tuple[float, ...] = number(
        (0.5, 0.25),
        "ratio",
        _WORSE,
        "of the sizes of a remainder with less freedom to the likeliest ones, which is tried where "
        "a region that is left out is predicted worse than by geometry and elasticity",
        "chosen: less still would gain little",
    )


REMAINDER = RemainderNumbers()
