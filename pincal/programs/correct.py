"""Correction of a program's points: sent the new ones by a nominal controller, the real arm reaches
the old ones.

A pose P of the tool T in the base B places the tip at W = B P T^-1. Of the nominal arm's joint
positions q that reach W, the ones in the program's posture are used; the calibrated model gives the
joint positions q' at which the real tip is at W. The corrected point is q', or the pose B^-1 FK(q')
T of the nominal arm at q'. A point is corrected as a whole or, with a reason, not at all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.compensation import compensate_poses
from pincal.compensate.robot_frames import false_targets
from pincal.model.conditions import Conditions
from pincal.programs.arms import ArmSearch, PoseSearch, ProgramAxes
from pincal.programs.flow import OUTSIDE
from pincal.programs.language import ControllerLanguage
from pincal.programs.program import (
    Edit,
    Frame,
    Load,
    Point,
    PointKey,
    Posture,
    Program,
    Skipped,
    counted_axes,
)
from pincal.programs.program_numbers import PROGRAM_NUMBERS
from pincal.robot.se3 import compose, inverse, transform
from pincal.thresholds import Count, Scale

# Difference of two frames with the same values, rounded [m and ratio].
_ROUNDED: Scale = 1e-9
# Poses at which a load is tried.
_TRIED: Count = 8
_REASONS = {
    "singular": "the arm is singular there: a small correction would need large joint motions",
    "joint_limit": "an axis would leave its limits",
    "unreachable": "no joint positions were found",
}


@dataclass(frozen=True, kw_only=True)
class ProgramCell:
    """What a program does not contain of the cell in which it runs.

    Attributes:
        tools, bases: poses of tools and bases by their names in programs, shape (4, 4) [m].
        world: shape (4, 4), the controller's world in the robot's base.
        flange: shape (4, 4), the controller's flange in the robot's tip.
        axes: the program's axes.
        seed: shape (n,), positions of the URDF's joints near which the program starts.
        payload: mass at the tip [kg].
        limits: whether axes have to stay within their limits.
        max_change: largest joint motion by a correction [rad or m].
    """

    axes: ProgramAxes
    tools: Mapping[str, np.ndarray] = field(default_factory=dict)
    bases: Mapping[str, np.ndarray] = field(default_factory=dict)
    world: np.ndarray = field(default_factory=lambda: np.eye(4))
    flange: np.ndarray = field(default_factory=lambda: np.eye(4))
    seed: np.ndarray | None = None
    payload: float = 0.0
    limits: bool = True
    max_change: float = float(np.deg2rad(2.0))


@dataclass(frozen=True)
class Change:
    """A corrected point.

    Attributes:
        point: the point as programmed.
        values: its corrected numbers, before rounding.
        q: shape (n,), the nominal arm's joint positions at the point as programmed.
        commanded: shape (n,), at the point as corrected.
        frames: the transforms before and after the pose of a point, from base and tool, shape (4,
            4) each.
        payload: mass at the tip there [kg].
        shift: translation of the point [m].
        turn: its rotation [rad].
        has_posture: whether the arm has the programmed posture and turns, which a line may not
            obey.
    """

    point: Point
    values: np.ndarray
    q: np.ndarray
    commanded: np.ndarray
    frames: tuple[np.ndarray, np.ndarray]
    payload: float
    shift: float
    turn: float
    has_posture: bool


@dataclass(frozen=True)
class _Use:
    """How a program first reaches a point: from which, if known, and whether along a line or a
    circle.
    """

    start: PointKey | None = None
    is_line: bool = False
    takes_posture: bool = True


@dataclass(frozen=True)
class _Row:
    """A point whose joint positions, frames and payload [kg] are known."""

    point: Point
    q: np.ndarray
    frames: tuple[np.ndarray, np.ndarray]
    payload: float


class Corrector:
    """Corrects points of programs by a calibrated model."""

    def __init__(
        self, calibrated: FittedRobot, language: ControllerLanguage, cell: ProgramCell
    ) -> None:
        # Internally, joints are those of the URDF; the program's axes convert from what the
        # controller reports.
        chain = calibrated.model.chain
        robot = replace(chain.robot, couplings=())
        calibrated = calibrated.with_model(
            calibrated.model.with_chain(replace(chain, robot=robot)),
            calibrated.estimate,
            nominal_values=calibrated.nominal_values,
        )
        self.calibrated = calibrated
        self.language = language
        self.cell = cell
        self.robot = robot
        self.arms = ArmSearch(robot, cell.axes)
        at = self.conditions(np.zeros((1, robot.n_joints)))
        # The calibrated target on the tip.
        self.target = compose(
            inverse(false_targets(calibrated, at)), false_targets(calibrated, at, of="target")
        )

    def conditions(self, q: np.ndarray, payloads: np.ndarray | None = None) -> Conditions:
        """Return the conditions of joint positions, shape (N, n), with the cell's payload or their
        own, shape (N,) [kg].
        """
        found = self.calibrated.conditions_at(q, payload=self.cell.payload)
        return found if payloads is None else replace(found, payload=np.asarray(payloads, float))

    @cached_property
    def is_elastic(self) -> bool:
        """Whether a load moves the tip of the calibrated model."""
        q = self.robot.random_configurations(_TRIED, np.random.default_rng(0))
        model = self.calibrated.model
        tips = [
            model.predict(self.calibrated.model_values, self.conditions(q, np.full(len(q), mass)))
            for mass in (0.0, 1.0)
        ]
        return bool(np.any(tips[0] != tips[1]))

    def payloads(self, program: Program) -> dict[PointKey, float | str]:
        """Return the mass at the tip at each point [kg], or why it is not known.

        A load that the program states in numbers is taken. One that it does not state in numbers
        is the cell's, unless the program has several loads.
        """
        if not self.is_elastic:
            return dict.fromkeys(program.points, self.cell.payload)
        texts = {
            load.text for loads in program.loads.values() for load in loads if load is not None
        }
        return {
            key: self._payload(program.loads.get(key, []), is_only=len(texts) == 1)
            for key in program.points
        }

    def _payload(self, loads: Sequence[Load | None], *, is_only: bool) -> float | str:
        """Return the mass at a point with these loads, or why it is not known."""
        masses = {self.cell.payload} if None in loads or not loads else set[float]()
        for load in loads:
            if load is None:
                continue
            if load.mass is None and not is_only:
                return (
                    f"line {load.line}: its load is not in numbers, and the program has several: "
                    "correct it as a program of its own (--payload)"
                )
            if load.mass is not None and not 0.0 <= load.mass <= PROGRAM_NUMBERS.heaviest:
                return (
                    f"line {load.line}: a load of {load.mass:g} kg; expected 0 to "
                    f"{PROGRAM_NUMBERS.heaviest:g} kg"
                )
            masses.add(self.cell.payload if load.mass is None else load.mass)
        return next(iter(masses)) if len(masses) == 1 else "motions reach it with different loads"

    def notes(self, program: Program) -> list[str]:
        """Return what is said of the loads that a program states."""
        if not self.is_elastic:
            return []
        loads = {
            load.text: load
            for key, found in program.loads.items()
            for load in found
            if load is not None and key in program.points
        }
        taken = "whose mass is not in numbers: {:g} kg is taken (--payload)"
        return [
            f"line {load.line} has a load ({load.text[:40]}), "
            + (f"{load.mass:g} kg" if load.mass is not None else taken.format(self.cell.payload))
            for load in loads.values()
        ]

    def frames(self, point: Point, program: Program) -> tuple[np.ndarray, np.ndarray] | str:
        """Return the transforms before and after a point's pose between base and tip, or why they
        are not known.
        """
        base = _known(point.base or Frame(""), self.cell.bases, program.bases, "base")
        tool = _known(point.tool or Frame(""), self.cell.tools, program.tools, "tool")
        if isinstance(base, str) or isinstance(tool, str):
            return base if isinstance(base, str) else str(tool)
        return self.cell.world @ base, np.linalg.inv(self.cell.flange @ tool)

    def changes(self, program: Program) -> tuple[dict[PointKey, Change], list[Skipped]]:
        """Return the corrections of a program's points, and what is not corrected."""
        skipped = list(program.skipped)
        framed = self._framed(program, skipped)
        uses = _first_uses(program)
        search, numbers = self._search(program, framed, uses)
        joints = dict[PointKey, np.ndarray]()
        for key, point in program.points.items():
            if key not in framed:
                continue
            q = (
                self.joints(point)
                if point.kind == "joints"
                else self._chosen(point, (search, numbers[key]), uses[key], joints)
            )
            if isinstance(q, str):
                skipped.append(point.skip(q))
            else:
                joints[key] = q
        payloads = self.payloads(program)
        rows = {}
        for key, q in joints.items():
            payload = payloads[key]
            if isinstance(payload, str):
                skipped.append(program.points[key].skip(payload))
            else:
                rows[key] = _Row(program.points[key], q, framed[key], payload)
        changed = self._corrected(rows, skipped)
        return self._with_turns(program, changed, skipped), skipped

    def _framed(
        self, program: Program, skipped: list[Skipped]
    ) -> dict[PointKey, tuple[np.ndarray, np.ndarray]]:
        """Return the frames of the points that can be corrected; the others are added to
        ``skipped``.
        """
        framed: dict[PointKey, tuple[np.ndarray, np.ndarray]] = {}
        nowhere = (self.cell.world, np.linalg.inv(self.cell.flange))
        for key, point in program.points.items():
            frames = self.frames(point, program) if point.kind == "pose" else nowhere
            if isinstance(frames, str):
                skipped.append(point.skip(frames))
            elif reason := self._refusal(point):
                skipped.append(point.skip(reason))
            else:
                framed[key] = frames
        return framed

    def _search(
        self,
        program: Program,
        framed: Mapping[PointKey, tuple[np.ndarray, np.ndarray]],
        uses: Mapping[PointKey, _Use],
    ) -> tuple[PoseSearch, dict[PointKey, int]]:
        """Return the search for the joint positions of all poses, and their numbers in it."""
        poses = {key: program.points[key] for key in framed if program.points[key].kind == "pose"}
        tips = [
            framed[key][0] @ self.language.pose(point.values) @ framed[key][1]
            for key, point in poses.items()
        ]
        # Where the programmed posture is not obeyed, all solutions are searched for.
        postures = [
            point.posture if uses[key].takes_posture else Posture() for key, point in poses.items()
        ]
        reached = np.array(tips).reshape(-1, 4, 4)[:, :3]
        search = PoseSearch(self.arms, reached, postures, self.cell.seed)
        return search, {key: i for i, key in enumerate(poses)}

    def _refusal(self, point: Point) -> str:
        if reason := self.language.refusal(point):
            return reason
        if point.kind == "joints":
            if len(point.numbers) != self.robot.n_joints:
                axes = counted_axes(len(point.numbers))
                return f"{axes}; the model has {self.robot.n_joints}"
            q = self.joints(point)
            if np.abs(q).max() > PROGRAM_NUMBERS.most_turned:
                return "its numbers are no joint positions"
            beyond = (q < self.robot.lower - 1e-6) | (q > self.robot.upper + 1e-6)
            if self.cell.limits and beyond.any():
                return (
                    f"{self.robot.joint_names[int(beyond.argmax())]} is beyond its limits in "
                    "the model"
                )
            return ""
        if self.robot.n_joints != 6:
            return (
                f"a pose does not determine the joints of an arm with {self.robot.n_joints} joints"
            )
        return ""

    def joints(self, point: Point, values: np.ndarray | None = None) -> np.ndarray:
        """Return the joint positions of a point in axes, shape (n,) [rad or m]."""
        given = point.values if values is None else values
        return np.asarray(self.cell.axes.to_robot((given * self._units)[None])[0])

    @cached_property
    def _units(self) -> np.ndarray:
        return self.language.joint_units(
            np.array([kind != "prismatic" for kind in self.robot.joint_types])
        )

    def _chosen(
        self,
        point: Point,
        place: tuple[PoseSearch, int],
        use: _Use,
        joints: dict[PointKey, np.ndarray],
    ) -> np.ndarray | str:
        """Return the joint positions with which a controller reaches a pose, or why they are not
        known.

        On a line or a circle an arm keeps its posture, unless it passes through a singular pose.
        """
        search, i = place
        start = joints.get(use.start) if use.start else None
        posture = self._posture(point, search, use, start)
        known = start
        if point.near is not None and len(point.near) == self.robot.n_joints:
            posture = point.posture
            known = self.joints(point, np.array(point.near))
        last = joints[next(reversed(joints))] if joints else self.cell.seed
        near = known if known is not None else last
        is_determined = known is not None or (self.arms.has_sides and posture.is_whole)
        if near is None and not is_determined:
            return (
                "nothing before it determines the arm configuration: give joint positions to "
                "start from (--seed-joints)"
            )
        near = np.zeros(self.robot.n_joints) if near is None else near
        clear = search.clear_choice(i, posture, near, known=known) if is_determined else None
        if clear is not None:
            return clear
        reached = self._nearest_first(search.all_of(i), posture, near)
        return self._first_of(reached, near, is_determined=is_determined)

    def _posture(
        self, point: Point, search: PoseSearch, use: _Use, start: np.ndarray | None
    ) -> Posture:
        """Return the posture in which a point is reached: on a line or a circle that of its
        start.
        """
        obeys = use.takes_posture and point.posture.is_whole
        if start is None or not use.is_line or not self.arms.has_sides or obeys:
            return point.posture
        front, up, down = (bool(side > 0.0) if side else None for side in search.sides_of(start))
        return Posture(front, up, down)

    @staticmethod
    def _first_of(
        reached: Sequence[np.ndarray], near: np.ndarray, *, is_determined: bool
    ) -> np.ndarray | str:
        """Return the first of some joint positions, or why it is not clear."""
        if not reached:
            return (
                "no joint positions within the limits reach it in its posture, by the nominal model"
            )
        if not is_determined and len(reached) > 1:
            first, second = (float(np.abs(q - near).max()) for q in reached[:2])
            if first > PROGRAM_NUMBERS.clearly * second:
                return (
                    "several arm configurations reach it, and the motion before it does not "
                    "determine one (--seed-joints)"
                )
        return reached[0]

    def _nearest_first(
        self, found: np.ndarray, posture: Posture, near: np.ndarray
    ) -> list[np.ndarray]:
        """Return those of some joint positions that a posture allows, turned as near others as
        possible.
        """
        arms = (
            found[[posture.allows(sides) for sides in self.arms.sides(found)]]
            if len(found)
            else found
        )
        turned = [self.arms.turned(q, posture, near) for q in arms]
        return sorted(
            (q for q in turned if q is not None), key=lambda q: float(np.sum((q - near) ** 2))
        )

    def solve(
        self, q: np.ndarray, tips: np.ndarray, payloads: np.ndarray
    ) -> tuple[np.ndarray, list[str]]:
        """Return the joints near q, shape (N, n), with the real tip at poses, shape (N, 3, 4), and
        reasons or "".
        """
        wanted = compose(tips, self.target)
        found = compensate_poses(
            self.calibrated,
            wanted,
            self.conditions(q, payloads),
            frame="base",
            limits=self.cell.limits,
        )
        reasons = [_REASONS.get(str(status), "") for status in found.status]
        moved = np.abs(found.q - q)
        before = self.arms.sides(q)
        after = self.arms.sides(found.q)
        for i in range(len(q)):
            if not reasons[i] and moved[i].max() > self.cell.max_change:
                joint = self.robot.joint_names[int(moved[i].argmax())]
                reasons[i] = (
                    f"{joint} would move by {np.rad2deg(moved[i].max()):.3g} deg (--max-change)"
                )
            elif not reasons[i] and np.any(before[i] * after[i] < 0.0):
                reasons[i] = "the correction would change the arm's posture"
        return found.q, reasons

    def _corrected(
        self,
        rows: Mapping[PointKey, _Row],
        skipped: list[Skipped],
    ) -> dict[PointKey, Change]:
        if not rows:
            return {}
        q = np.array([row.q for row in rows.values()])
        payloads = np.array([row.payload for row in rows.values()])
        tips = self.arms.tips(q)
        commanded, reasons = self.solve(q, tips, payloads)
        moved = self.arms.tips(commanded)
        sides = self.arms.sides(q)
        axes = self.cell.axes.to_program(commanded)
        changes = {}
        for i, (key, row) in enumerate(rows.items()):
            if reasons[i]:
                skipped.append(row.point.skip(reasons[i]))
                continue
            point = row.point
            before, after = self._poses(row, (tips[i], moved[i]))
            values = (
                self.language.numbers(after, point.values)
                if point.kind == "pose"
                else axes[i] / self._units
            )
            # The angle of a small rotation, without the loss of a cosine near 1.
            apart = np.linalg.norm(after[:3, :3] - before[:3, :3]) / np.sqrt(8.0)
            turn = 2.0 * float(np.arcsin(min(apart, 1.0)))
            shift = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
            has_it = point.posture.allows(sides[i]) and self.arms.has_turns(q[i], point.posture)
            changes[key] = Change(
                point, values, q[i], commanded[i], row.frames, row.payload, shift, turn, has_it
            )
        return changes

    @staticmethod
    def _poses(row: _Row, tips: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the poses of a point's tool in its base, shape (4, 4), at poses of the tip, shape
        (3, 4).
        """
        base, tool = (np.linalg.inv(frame) for frame in row.frames)
        return [base @ transform(tip[:, :3], tip[:, 3]) @ tool for tip in tips]

    def _with_turns(
        self, program: Program, changes: dict[PointKey, Change], skipped: list[Skipped]
    ) -> dict[PointKey, Change]:
        """Return the changes except those that would change a turn number shared by
        several points.
        """
        shared = Counter(
            (p.source, n)
            for p in program.points.values()
            for n in {t.number for t in p.posture.turns}
        )
        kept = {}
        for key, change in changes.items():
            point = change.point
            new = {edit.start for edit in self.turn_edits(change)}
            if any(
                shared[point.source, t.number] > 1
                for t in point.posture.turns
                if t.number.start in new
            ):
                skipped.append(point.skip("it shares a turn number, which would change"))
            else:
                kept[key] = change
        return kept

    def turn_edits(self, change: Change) -> list[Edit]:
        """Return the edits of a point's turn numbers."""
        point = change.point
        axes = self.cell.axes.to_program(change.commanded[None])[0]
        edits = []
        for number in dict.fromkeys(
            turn.number for turn in point.posture.turns if change.has_posture
        ):
            turns = [turn for turn in point.posture.turns if turn.number == number]
            text = self.language.turn_text(
                turns, axes, self.cell.axes.to_program(change.q[None])[0]
            )
            if text != number.text:
                edits.append(Edit(point.source, number.start, number.end, text))
        return edits

    def edits(self, change: Change) -> list[Edit]:
        """Return the edits of one point."""
        if (
            max(change.shift, change.turn, float(np.abs(change.commanded - change.q).max()))
            < PROGRAM_NUMBERS.nothing
        ):
            return []
        texts = self.language.point_numbers(change.point, change.values)
        pairs = zip(change.point.numbers, texts, strict=True)
        edits = [
            Edit(change.point.source, n.start, n.end, text) for n, text in pairs if text != n.text
        ]
        return edits + self.turn_edits(change)


def _first_uses(program: Program) -> dict[PointKey, _Use]:
    """Return how a program first reaches each of its points."""
    uses = dict.fromkeys(program.points, _Use())
    before: tuple[int, int] | None = None
    seen = set[PointKey]()
    at = None
    for motion, stops in program.motions:
        at = at if (motion.source, motion.run) == before else None
        for key in stops:
            if key is not None and key in uses and key not in seen:
                uses[key] = _Use(at, motion.path != "joint", motion.takes_posture)
                seen.add(key)
            at = key
        at = at if stops else None
        before = (motion.source, motion.run)
    return uses


def _known(
    frame: Frame,
    given: Mapping[str, np.ndarray],
    declared: Mapping[str, np.ndarray | str],
    option: str,
) -> np.ndarray | str:
    """Return the pose of a frame, or why it is not known.

    What the program itself does to a frame comes before the values of an option; only what a
    routine in none of the files may do is answered by it.
    """
    if frame.pose is not None:
        return frame.pose
    wanted = given.get(frame.name)
    if frame.reason:
        return wanted if wanted is not None and OUTSIDE in frame.reason else frame.reason
    pose = declared.get(frame.name)
    if isinstance(pose, str):
        return f"{option} {frame.name}: {pose}"
    if pose is not None and wanted is not None and not np.allclose(pose, wanted, atol=_ROUNDED):
        return f"{option} {frame.name}: the program states other values than --{option}"
    found = pose if pose is not None else wanted
    if found is None:
        return (
            f"the values of {frame.name or option} are not known: give --{option} "
            f"'{frame.name or option}=X,Y,Z,...'"
        )
    return found
