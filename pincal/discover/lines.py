"""Lines of a drive: waves that the span of a joint can't tell apart are one, and an order may say where it comes from.

Over S turns of a joint a line shows orders 1 / S to either side of its own; two that are less than 2 / S apart are as well
one between them that waxes and wanes once over the span, as the load or the mesh of a gear makes it.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from pincal.discover.candidate_tests import Search
from pincal.discover.decisions import each_heading_once
from pincal.discover.forward import listed
from pincal.discover.history import History, State, Step
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit, without
from pincal.identify.moment_frames import misfit
from pincal.model.catalogue.tones import resolution_of
from pincal.model.effect import Effect, Tone

log = logging.getLogger(__name__)

# Resolutions apart up to which two waves may be one line: each is within one of the middle.
_ONE_LINE = 2.0


def name_lines(state: State, search: Search) -> State:
    """Take waves that the span of their joint can't tell apart as one line, and give it the name that its order suggests."""
    for step in _lines(state.steps):
        state = _joined(state, step)
    for wave in sorted((step.effect for step in _lines(state.steps)), key=_order):
        found = next((step for step in state.steps if step.effect is wave), None)
        state = state if found is None else _as_suggested(state, found, search)
    return state


def told_of_line(trail: History, step: Step) -> dict[str, Any]:
    """Return what is to be said of a line beside its name: fields of :class:`FoundEffect`; nothing of other effects."""
    if not isinstance(step.effect, Tone):
        return {}
    width, orders = _resolution(trail.final, step.effect), [_order(effect) for effect in step.effects]
    wheels = {_order(e): "which the user named" for e in trail.extra if isinstance(e, Tone)}
    for other in _lines(trail.steps):
        if other is not step and isinstance(other.effect, Tone) and other.effect.band is not None:
            wheels.setdefault(_order(other.effect), f"a line of {other.effect.locus.joint}")
    origin = step.effect.origin(float(np.mean(orders)), width, wheels)
    return {"resolution": width, "beside": tuple(orders[1:]), "origin": origin}


def _lines(steps: tuple[Step, ...]) -> list[Step]:
    return [step for step in steps if isinstance(step.effect, Tone)]


def _order(effect: Effect) -> float:
    return effect.locus.order or 0.0


def _resolution(fit: Fit, effect: Effect) -> float:
    joint = fit.problem.chain.robot.joint_names.index(str(effect.locus.joint))
    return resolution_of(fit.problem.conditions.q[fit.solution.weights > 0.0, joint])


def _joined(state: State, step: Step) -> State:
    """Return the state in which a wave is part of an earlier line, if it is no further from it than the span tells."""
    near = _ONE_LINE * _resolution(state.fit, step.effect)
    earlier = _lines(state.steps[: state.steps.index(step)])
    line = next((s for s in earlier if all(_is_near(step.effect, part, near) for part in s.effects)), None)
    if line is None:
        return state
    parts = (*line.effects, *step.effects)
    log.info("%s: one line with %s", listed(step.effects), listed(line.effects[:1]))
    others = tuple(other for other in line.equivalent if not any(_is_near(other, part, near) for part in parts))
    return state.with_replaced(line, replace(line, effects=parts, equivalent=others)).without_step(step)


def _is_near(effect: Effect, other: Effect, near: float) -> bool:
    """Return whether two effects are waves of one name on one joint, and of nearly one order."""
    return effect.heading == other.heading and abs(_order(effect) - _order(other)) < near


def _as_suggested(state: State, step: Step, search: Search) -> State:
    """Return the state with the cause that the order of a line suggests in its place, and of others that this has in it.

    It has to explain the data as well in the very order that it has by its nature.
    """
    wave, *others = step.effects
    width = _resolution(state.fit, wave)
    assert isinstance(wave, Tone)
    cause = wave.suggested(width)
    if others or cause == wave:
        return state
    on_joint = [s.effects for s in _lines(state.steps) if s.effect.locus.joint == wave.locus.joint]
    inside = [part for part in on_joint if all(min(abs(_order(e) - k) for k in cause.orders) < width for e in part)]
    rest = state.fit
    for effect in (effect for part in inside for effect in part):
        rest = without(rest, effect)
    after = refit(rest, [*rest.options.effects, cause], start={})
    if misfit(after) > misfit(state.fit) + search.policy.tie:
        return state
    log.info("%s is %s by its order", listed([wave]), listed([cause]))
    told = each_heading_once([wave, *(e for e in step.equivalent if not _is_near(e, cause, width))], cause, search.policy)
    state = state.tuned(step, replace(step, effects=(cause,), equivalent=told, after=after))
    if gone := [part for part in inside if part[0] is not wave]:
        left = tuple(effect for part in gone for effect in part)
        state = state.changed(after, tuple(s for s in state.steps if s.effects not in gone), (), left)
    return state
