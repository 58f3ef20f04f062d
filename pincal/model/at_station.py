"""Effects present at one of several stations only: a drift of its own, a joint that jumped between
two days.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, Curve, Effect, Family, Locus, Term
from pincal.parameters import Parameter, Scope


@dataclass(frozen=True)
class AtStation(Effect):
    """An effect with separate parameters at one station.

    For an effect that all stations share, the station's parameters are added to the robot's; their
    names end in ``_here``.

    Distinguished by:
        measuring one or two poses of the station again at another station: what persists belongs to
        the robot, the rest to
            the station.

    Source:
        pincal's own, for effects of the catalogue.

    Attributes:
        effect: the effect; not one of static moments.
        station: name of the station.
        joint: the joint whose parameters it has; default: all of them.
    """

    effect: Effect
    station: str
    joint: str | None = None
    name: ClassVar[str] = "at_station"
    meaning: ClassVar[str] = "an effect present at one station only"
    scope: ClassVar[Scope] = "station"

    @property
    def locus(self) -> Locus:
        at = self.effect.locus
        return replace(
            at, joint=at.joint or self.joint, station=self.station, cause=self.effect.name
        )

    @property
    def is_sighted(self) -> bool:
        return self.effect.is_sighted

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The effect's parameters of the joint."""
        of_effect = self.effect.parameters(chain)
        mark = "" if self.effect.scope == "station" else "_here"
        kept = [of_effect[i] for i in self._kept(chain)]
        return tuple(replace(p, name=p.name + mark, effect=self.name, nominal=0.0) for p in kept)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Return the effect's terms of these parameters."""
        place = {i: k for k, i in enumerate(self._kept(chain))}
        found = [
            term
            for term in self.effect.terms(chain, conditions, moments)
            if term.parameter in place
        ]
        return tuple(term._replace(parameter=place[term.parameter]) for term in found)

    def _kept(self, chain: Chain) -> list[int]:
        parameters = self.effect.parameters(chain)
        return [
            i for i, parameter in enumerate(parameters) if self.joint in (None, parameter.element)
        ]


def own_effects(candidates: Iterable[Candidate], station: str) -> Iterator[AtStation]:
    """Yield the effects of station scope, such as a drift, among a station's candidates."""
    for candidate in candidates:
        yield from (AtStation(form, station) for form in candidate.forms if form.scope == "station")


def changed_effects(
    effects: Collection[Effect], situation: PoseSet, tested: Sequence[Candidate], station: str
) -> list[AtStation]:
    """Return the effects of single joints whose parameters may differ at a station.

    These are joint offsets, named causes, and drive curves from coarse to fine as far as the
    station's poses (``situation``) support them; of the curves ``tested`` for drives that have none
    in the model, the coarsest.
    """
    found = list[AtStation]()
    joints = situation.joints
    for effect in effects:
        at = effect.locus
        if effect.uses_moments or effect.scope == "station" or at.station is not None:
            continue
        if effect.family is Family.GEOMETRY and at.acts_on == "drive":
            found += (AtStation(effect, station, joint) for joint in joints)
        elif isinstance(effect, Curve) and at.joint is not None:
            forms = (candidate.forms for candidate in type(effect).candidates(situation))
            found += (
                AtStation(form, station)
                for some in forms
                for form in some
                if form.locus.joint == at.joint
            )
        elif effect.family is Family.CAUSE and at.joint is not None:
            found.append(AtStation(effect, station))
    return list(
        dict.fromkeys(
            [*found, *(AtStation(form, station) for form in drive_forms(effects, tested))]
        )
    )


def drive_forms(effects: Iterable[Effect], tested: Iterable[Candidate]) -> list[Effect]:
    """Return the simplest form of each candidate error of a drive with its own position, for drives
    without a curve.
    """
    with_curves = [effect.locus.joint for effect in effects if isinstance(effect, Curve)]
    forms = (form for of in tested for form in of.forms[:1] if form.locus.joint not in with_curves)
    return [
        form
        for form in forms
        if form.locus.acts_on == "drive" and form.locus.follows == form.locus.joint
    ]
