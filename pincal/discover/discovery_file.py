"""Results of a discovery: the structure behind ``discovery.json``, the report and the terminal."""

from __future__ import annotations

from typing import Any, Literal, Self

import msgspec

from pincal.errors import counted
from pincal.model.effect import Effect
from pincal.notes import Note
from pincal.validate.misfit import SURE, Verdict


class Gap(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Errors on held-out rows, or on the fitted ones if none were held out.

    Attributes:
        mean_mm, rms_mm, max_mm: of the position [mm].
        mean_mrad, rms_mrad, max_mrad: of the orientation, where it was measured [mrad].
    """

    mean_mm: float
    rms_mm: float
    max_mm: float
    mean_mrad: float | None = None
    rms_mrad: float | None = None
    max_mrad: float | None = None


class EffectName(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Identity of an effect.

    Attributes:
        effect: its name in the catalogue.
        joint: the joint on which it acts; null for one of the whole arm.
        source: the joint whose position it follows, if another one.
        order: cycles per revolution of the joint, of a periodic effect; not along a prismatic one.
        period: of waves along a prismatic joint [m]; of an effect that was found and has no name,
            of any periodic dependence.
        period_unit: unit of the period.
        depends_on: the variable of an effect without a name: a joint, "time", "temperature" or
            "payload".
        acts_on: the coordinate on which an effect without a name acts: "drive", "gamma_x",
            "gamma_y", "s_x" or "s_y"; of a prismatic joint also "gamma_z" or "a".
        shape: form of a dependence without a name: "curve", "waves", "product", "map", "field",
            "step" or "kink".
        place: position of its break along the variable [unit of the variable].
        station: name of the only station with it.
    """

    effect: str
    joint: str | None
    source: str | None = None
    order: int | float | None = None
    period: float | None = None
    period_unit: str | None = None
    depends_on: str | None = None
    acts_on: str | None = None
    shape: str | None = None
    place: float | str | None = None
    station: str | None = None

    @classmethod
    def of(cls, effect: Effect, **more: Any) -> Self:
        """Return the name of an effect; ``more`` are the fields of a subclass.

        Example:
            >>> from pincal.model.catalogue import JointCoupling
            >>> msgspec.to_builtins(EffectName.of(JointCoupling("joint_5", "joint_4")))
            {'effect': 'joint_coupling', 'joint': 'joint_5', 'source': 'joint_4'}
        """
        name, joint, source = effect.heading
        at = effect.locus
        nameless = effect.is_nameless
        return cls(
            effect=name,
            joint=joint,
            source=source,
            order=at.order if at.period is None else None,
            depends_on=at.follows if nameless else None,
            acts_on=at.acts_on if nameless else None,
            shape=at.shape,
            place=at.place,
            station=at.station,
            **{"period": at.period, "period_unit": "m" if at.period else None, **more},
        )

    @property
    def in_tables(self) -> EffectName:
        """What of the name tables of one robot have in common: of an effect without a name what it
        depends on and where it acts, but neither its shape nor its orders.
        """
        return EffectName(
            effect=self.effect,
            joint=self.joint,
            source=self.source,
            depends_on=self.depends_on,
            acts_on=self.acts_on,
        )


class Stage(Gap, frozen=True, kw_only=True, omit_defaults=True):
    """Errors after one change of the model; each starts from the stage before.

    Attributes:
        name: the change, in words.
        entered, left: effects added to the model by this change, and removed.
        share: share of this change in the total reduction of the mean square error; all shares add
            up to 1. Negative where it grew; none for the first stage, or without a reduction.
    """

    name: str
    entered: tuple[EffectName, ...] = ()
    left: tuple[EffectName, ...] = ()
    share: float | None = None

    @property
    def gap(self) -> Gap:
        """The errors alone."""
        return Gap(**{key: getattr(self, key) for key in Gap.__struct_fields__})


class FoundParameter(msgspec.Struct, frozen=True):
    """A parameter of an effect.

    Attributes:
        value: its estimate [``unit``].
        sigma: its standard deviation [``unit``]; of the prior where it was not fitted, null if
            unknown.
        unit: the unit.
    """

    value: float
    sigma: float | None
    unit: str


class Stability(msgspec.Struct, frozen=True, omit_defaults=True):
    """How often a search repeated on subsamples of the poses finds the same name.

    Attributes:
        named: number of subsamples in which it is found.
        of: number of subsamples.
        alternatives: number of further subsamples in which what it could also be is found instead.
    """

    named: int
    of: int
    alternatives: int = 0

    @property
    def share(self) -> float:
        """Fraction of the subsamples, 0 to 1."""
        return self.named / self.of

    @property
    def words(self) -> str:
        """How often, in a sentence.

        Example:
            >>> Stability(20, 20).words, Stability(0, 20, 15).words
            ('in 20 of 20 subsamples', 'in 0 of 20 subsamples, and in 15 others an alternative')
        """
        others = counted(self.alternatives, "other")
        rest = f", and in {others} an alternative" if self.alternatives else ""
        return f"in {self.named} of {self.of} subsamples{rest}"

    def __str__(self) -> str:
        rest = f" (an alternative in {self.alternatives})" if self.alternatives else ""
        return f"in {self.named} of {self.of}{rest}"


class Repeated(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """A name, and in how many subsamples it is found.

    Attributes:
        stability: how often.
    """

    stability: Stability


class Bootstrap(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """Significance of the effect accepted last, including the selection among all candidates.

    Attributes:
        p_value: fraction of tables drawn from the model without it, and of the measured one, in
            which some candidate is as good.
        draws: number of drawn tables.
    """

    p_value: float
    draws: int


class FoundEffect(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that was found; elasticity of a single joint.

    Attributes:
        resolution: uncertainty of the order of a ripple [1/revolution]: one over the revolutions of
            the joint.
        beside: orders of further harmonics within this resolution, by which the amplitude varies
            over the span.
        origin: origin of the ripple as suggested by its order; empty if unknown.
        parameters: its parameters by name.
        p_value: probability of this result without the effect.
        gap_before_mm, gap_after_mm: mean error on held-out rows before it entered the model, and
            with it.
        gap_before_mrad, gap_after_mrad: the same for the orientation, where it was measured.
        equivalent: effects that the data can't distinguish from it.
        tell_apart: the cheapest measurement that would distinguish it from the first of them; empty
            without one.
        stability: number of subsamples in which the search finds it; None if not tested.
    """

    resolution: float | None = None
    beside: tuple[float, ...] = ()
    origin: str = ""
    parameters: dict[str, FoundParameter]
    p_value: float
    gap_before_mm: float
    gap_after_mm: float
    gap_before_mrad: float | None = None
    gap_after_mrad: float | None = None
    equivalent: tuple[EffectName, ...]
    tell_apart: str
    stability: Stability | None = None

    @property
    def is_hint(self) -> bool:
        """Whether it is only a hint, found in few subsamples."""
        return self.stability is not None and self.stability.share < SURE


class Disagreement(msgspec.Struct, frozen=True, omit_defaults=True):
    """Where model and data disagree.

    Attributes:
        statement: description in words.
        share: part of the excess over the noise, 0 to 1.
        joint: the joint; None for a region.
        region: the region, if not a single joint: "whole arm", "reach 0.80 to 1.10 m", ...
        acts_on: the coordinate, if known: "drive", "gamma_x", "base", ...
        depends_on: the variable on which it depends, if known.
    """

    statement: str
    share: float
    joint: str | None = None
    region: str | None = None
    acts_on: str | None = None
    depends_on: str | None = None


class ScatteringJoint(msgspec.Struct, frozen=True):
    """A joint that does not return to the same position.

    Attributes:
        joint: the joint.
        sigma_rad: standard deviation of its position [rad; m of a sliding joint].
        missing: the column that could explain it.
        shown_by: evidence that it is not a function of the pose: "replicates" or "neighbours"; ""
            if unknown.
    """

    joint: str
    sigma_rad: float
    missing: str
    shown_by: Literal["replicates", "neighbours", ""] = ""


class Untestable(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that these data can't test, and why.

    Attributes:
        reason: why, in words: a column that is missing, a joint that stood still.
    """

    reason: str


class SmoothPart(msgspec.Struct, frozen=True, kw_only=True):
    """A part of what is smooth in the joints and has no name.

    Attributes:
        errs: "drive": each drive errs; "base": the target is displaced along the base's axes.
        depends_on: the joints of whose positions it is a function.
        length_rad: over which errors are alike [rad].
        size: root mean square of the error of a drive, or of a coordinate of the target, over the
            fitted rows [``unit``].
        sigma: standard deviation of the same where no pose was measured nearby [``unit``].
        unit: "rad" or "m".
        parameters: number of its amplitudes, which are in ``model.json``.
    """

    errs: Literal["drive", "base"]
    depends_on: tuple[str, ...]
    length_rad: float
    size: float
    sigma: float
    unit: Literal["rad", "m"]
    parameters: int


class Region(msgspec.Struct, frozen=True, kw_only=True):
    """A region of joint space, predicted by fits of the others; of ten rows or more, if the table
    has them.

    Attributes:
        rows: number of its rows.
        calibrated_mm: mean error by geometry and elasticity, as ``pincal calibrate`` fits them
            [mm].
        named_mm: by these and the names that were found.
        smooth_mm: with what has no name as well; nowhere more than ``calibrated_mm``.
        centre: mean position of each joint [rad or m].
    """

    rows: int
    calibrated_mm: float
    named_mm: float
    smooth_mm: float
    centre: dict[str, float]

    @property
    def is_worse(self) -> bool:
        """Whether it is predicted worse than by names alone."""
        return self.smooth_mm > self.named_mm


class NamedRegion(msgspec.Struct, frozen=True, kw_only=True):
    """A region of joint space, predicted by fits of the others with the names alone; of ten rows or
    more, if the table has them.

    Attributes:
        rows: number of its readings.
        calibrated_mm: mean error by geometry and elasticity, as ``pincal calibrate`` fits them
            [mm].
        named_mm: with the names that were found.
        chance: probability that scatter alone makes the names look as much worse as here, or more.
        centre: mean position of each joint [rad or m].
    """

    rows: int
    calibrated_mm: float
    named_mm: float
    chance: float
    centre: dict[str, float]

    @property
    def is_worse(self) -> bool:
        """Whether names predict it worse, be it by chance."""
        return self.named_mm > self.calibrated_mm


class Smooth(msgspec.Struct, frozen=True, kw_only=True):
    """What is smooth in the joints and has no name: it predicts, and says nothing of causes.

    Attributes:
        parts: the errors.
        named_mm: mean error of all rows, region by region left out, without it [mm].
        smooth_mm: with it.
        regions: the regions, one by one.
    """

    parts: tuple[SmoothPart, ...]
    named_mm: float
    smooth_mm: float
    regions: tuple[Region, ...]

    @property
    def doubtful(self) -> tuple[Region, ...]:
        """The regions that are predicted worse than by names alone."""
        return tuple(region for region in self.regions if region.is_worse)


class Findings(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Results of a discovery, the content of ``discovery.json``.

    Attributes:
        noise_floor_mm: contribution of the noise alone to the error.
        gap: errors at the start and at the end.
        chain: errors at the start and after each change of the model, including removals.
        where: where model and data disagree before effects are added.
        effects: the effects found, in the order of acceptance.
        scatter: the joint that scatters, if any.
        not_testable: effects that these data can't test.
        verdict: whether the final model explains the data down to an independently known noise.
        unexplained_mm: residual in excess of the noise.
        hints: effects found in less than 60 % of the subsamples.
        only_in_halves: names found in at least 60 % of the subsamples, but not in the full data
            set.
        poses_in_a_half: number of poses of each subsample; None if not tested.
        bootstrap: significance of the effect accepted last; None if not tested, or none was
            accepted.
        approach_from: origin of the directions of approach; None if unknown.
        warnings: further messages, doubts first, as in ``result.json``.
        held_out: the gap on rows held out in each way, "regions" of joint space and "stretches" of
            consecutive rows; ``gap`` is the one that is larger at the end.
        remainder: what is smooth in the joints and has no name, as far as it predicts regions that
            were left out, and none of them worse than by geometry and elasticity; none otherwise,
            or if it was not wanted.
        delivered: what ``model.json`` has: "calibrated", geometry and elasticity alone; "named",
            the names as well; "smooth", what has no name as well.
        regions: regions that are left out, by geometry and elasticity and with the names; none
            without names, and where ``remainder`` has them.
    """

    noise_floor_mm: float
    gap: dict[Literal["before", "after"], Gap]
    chain: tuple[Stage, ...] = ()
    where: tuple[Disagreement, ...]
    effects: tuple[FoundEffect, ...]
    scatter: tuple[ScatteringJoint, ...]
    not_testable: tuple[Untestable, ...]
    verdict: Verdict
    unexplained_mm: float
    hints: tuple[Repeated, ...] = ()
    only_in_halves: tuple[Repeated, ...] = ()
    poses_in_a_half: int | None = None
    bootstrap: Bootstrap | None = None
    approach_from: str | None = None
    warnings: tuple[Note, ...] = ()
    held_out: dict[str, dict[Literal["before", "after"], Gap]] = {}
    remainder: Smooth | None = None
    delivered: Literal["calibrated", "named", "smooth"] | None = None
    regions: tuple[NamedRegion, ...] = ()
