"""What a discovery found: the one structure behind ``discovery.json``, the report and the terminal."""

from __future__ import annotations

from typing import Any, Literal, Self

import msgspec

from pincal.model.effect import Effect
from pincal.notes import Note
from pincal.validate.verdict import Verdict

# Part of the halves of the poses in which a name has to come up to be more than a hint.
SURE = 0.6


class Gap(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Errors on held-out rows, on the fitted ones where none were held out.

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
    """What tells an effect from its likes.

    Attributes:
        effect: its name in the catalogue.
        joint: the joint on which it acts; null for one of the whole arm.
        source: the joint whose position it follows, where that is another one.
        order: waves per turn of the joint, of a periodic effect.
        depends_on: the variable that an effect without a name follows: a joint, "time", "temperature" or "payload".
        acts_on: what an effect without a name moves: "drive", "gamma_x", "gamma_y", "s_x" or "s_y".
        shape: form of a dependence without a name: "curve", "waves", "product", "map", "step" or "kink".
        place: where along its variable it breaks [unit of the variable].
        station: name of the station that alone has it.
    """

    effect: str
    joint: str | None
    source: str | None = None
    order: int | float | None = None
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
        (name, joint, source), at, nameless = effect.heading, effect.locus, effect.is_nameless
        return cls(
            effect=name,
            joint=joint,
            source=source,
            order=at.order,
            depends_on=at.follows if nameless else None,
            acts_on=at.acts_on if nameless else None,
            shape=at.shape,
            place=at.place,
            station=at.station,
            **more,
        )


class Stage(Gap, frozen=True, kw_only=True, omit_defaults=True):
    """Errors after one change of the model; the change begins where the stage before it ended.

    Attributes:
        name: what changed, in words.
        entered, left: effects that this change added to the model, and that it took out again.
        share: part of what the mean square error fell by in all, by this change beside those before it; all shares add up
            to 1. Negative where it grew; none of the first stage, or where nothing fell.
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
        value: what was found [``unit``].
        sigma: its standard deviation [``unit``]; that of the prior where it was not fitted, null where nothing is known.
        unit: the unit.
    """

    value: float
    sigma: float | None
    unit: str


class Stability(msgspec.Struct, frozen=True):
    """How often a search repeated on halves of the poses came to the same name.

    Attributes:
        named: number of halves in which it came up.
        of: number of halves that were searched.
    """

    named: int
    of: int

    @property
    def share(self) -> float:
        """The part of the halves, 0 to 1."""
        return self.named / self.of

    def __str__(self) -> str:
        return f"in {self.named} of {self.of}"


class Repeated(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """A name, and how often it came up in halves of the poses.

    Attributes:
        stability: how often.
    """

    stability: Stability


class Bootstrap(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """How likely the effect that was accepted last is chance, the choice among all candidates included.

    Attributes:
        p_value: part of the tables drawn from the model without it in which some candidate looks as good, this one counted.
        draws: how many were drawn.
    """

    p_value: float
    draws: int


class FoundEffect(EffectName, frozen=True, kw_only=True, omit_defaults=True):
    """An effect that was found; of elasticity that of one joint.

    Attributes:
        period: of a periodic dependence without a name, in units of its variable.
        resolution: of an order of fine waves, by how much it may be off [1/turn]: one over the turns of the joint.
        beside: orders of further waves that are no further away: with them the line waxes and wanes over the span.
        origin: what the order suggests of where the waves come from, in words; empty if nothing.
        parameters: its parameters by name.
        p_value: chance that sound data look like this.
        gap_before_mm, gap_after_mm: mean error on held-out rows before it entered the model, and with it.
        gap_before_mrad, gap_after_mrad: the same of orientation, where that was measured.
        equivalent: effects that the data can't tell from it.
        tell_apart: the cheapest measurement that would tell it from the first of them; empty without one.
        stability: how often the search names it in halves of the poses; None where nobody looked.
    """

    period: float | None = None
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
        """Whether it comes up so seldom in halves of the poses that nobody should bet on it."""
        return self.stability is not None and self.stability.share < SURE


class Disagreement(msgspec.Struct, frozen=True, omit_defaults=True):
    """Where model and data disagree.

    Attributes:
        statement: what is to be said of it.
        share: part of the excess over the noise, 0 to 1.
        joint: the joint; None for a region.
        region: the region, where it is not one joint: "whole arm", "reach 0.80 to 1.10 m", ...
        acts_on: what moves there, where that is known: "drive", "gamma_x", "base", ...
        depends_on: the variable that it follows, where that is known.
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
        shown_by: what shows that it is no function of the pose: "replicates" or "neighbours"; "" where a file does not tell.
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


class Findings(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a discovery found, the whole of ``discovery.json``.

    Attributes:
        noise_floor_mm: what the noise alone makes of the error.
        gap: errors at the start and in the end.
        chain: errors at the start and after each change of the model, what was taken out again among them.
        where: where model and data disagree, before anything is named.
        effects: what was found, in the order in which it entered the model.
        scatter: the joint that scatters in the end, if one does.
        not_testable: what these data can't show.
        verdict: whether the model explains the data in the end, down to a noise that is known without it.
        unexplained_mm: what is left beyond the noise.
        hints: which of the effects come up in less than 60 % of the halves of the poses.
        only_in_halves: names that come up in at least 60 % of the halves, but not in all poses.
        poses_in_a_half: how many poses each half has; None where nobody looked.
        bootstrap: whether the effect that was accepted last may be chance; None where nobody looked, or none was.
        approach_from: where the side from which joints arrived comes from; None where a table doesn't tell any.
        warnings: what else is to be said, doubts first, as in ``result.json``.
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
