"""The language of Universal Robots: poses in metres with rotation vectors, joints in radians."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.programs.draft import Draft
from pincal.programs.flow import Code, InForce, Step, followed
from pincal.programs.language import LANGUAGES, ControllerLanguage
from pincal.programs.line_flow import POSITIONS, STATED_LOAD
from pincal.programs.program import Frame, Motion, Path, Point, Posture, Program, Skipped
from pincal.programs.statement_reader import Entries, Reader
from pincal.programs.syntax import (
    Brackets,
    Source,
    Statement,
    aggregate,
    call_of,
    calls_in,
    element_name,
    is_token,
    nested,
    number_of,
    numbers_of,
    place_of,
    split,
    text_of_items,
)
from pincal.programs.understood import Understood, understood_words
from pincal.thresholds import Count

_TOKENS = r"""
TEXT: /"[^"\r\n]*"/ | /'[^'\r\n]*'/
BITS.3: /0[xXbB][0-9a-fA-F]+/
SIGN: /[=<>!]=|[^\x04\s\w()\[\]{}"'#$]/
_END: /\r\n|\r|\n|\x04/
COMMENT.5: /#[^\r\n]*/
%ignore COMMENT
%ignore /[ \t\f\xa0]+/
"""
_WORDS = "URScript: def, thread, if, while and for, each with its end"
_MOTIONS: dict[str, Path] = {"movej": "joint", "movel": "line", "movep": "line", "movec": "circle"}
_ENDLESS = ("servoj", "servoc", "servol", "speedj", "speedl")
_MANUAL = "Universal Robots, script manual (PolyScope 5)"
_SCRIPT_WORDS = (
    Understood(
        "function",
        f"{_MANUAL}: module motion (ends of motions, kinematics; no motion of its own)",
        "stopj, stopl, stops, force_mode_set_damping, force_mode_set_gain_scaling, "
        "get_freedrive_status, get_conveyor_tick_count, set_conveyor_tick_count, "
        "conveyor_pulse_decode, encoder_enable_pulse_decode, encoder_enable_set_tick_count, "
        "encoder_get_tick_count, encoder_set_tick_count, encoder_unwind_delta_tick_count, "
        "position_deviation_warning, "
        "is_within_safety_limits, is_steady",
    ),
    Understood(
        "function",
        f"{_MANUAL}: module internals",
        "get_actual_joint_positions, get_actual_joint_positions_history, get_actual_joint_speeds, "
        "get_actual_tcp_pose, get_actual_tcp_speed, get_actual_tool_flange_pose, "
        "get_controller_temp, get_forward_kin, get_inverse_kin, get_inverse_kin_has_solution, "
        "get_joint_temp, get_joint_torques, get_steptime, get_target_joint_positions, "
        "get_target_joint_speeds, get_target_payload, get_target_payload_cog, "
        "get_target_payload_inertia, get_target_tcp_pose, get_target_tcp_speed, "
        "get_target_waypoint, get_tcp_force, get_tcp_offset, get_tool_accelerometer_reading, "
        "get_tool_current, popup, powerdown, sleep, str_at, str_cat, str_empty, str_find, str_len, "
        "str_sub, sync, textmsg, to_num, to_str, assert, time, force, rpc_factory, "
        "get_target_tcp_pose_along_path, get_target_tcp_speed_along_path, "
        "set_payload, set_payload_cog, set_payload_mass, "
        "set_target_payload, set_gravity, set_flag, get_flag, halt, rtde_set_watchdog, "
        "request_boolean_from_primary_client, request_float_from_primary_client, "
        "request_integer_from_primary_client, request_string_from_primary_client",
    ),
    Understood(
        "function",
        f"{_MANUAL}: module urmath",
        "acos, asin, atan, atan2, binary_list_to_integer, ceil, cos, d2r, floor, get_list_length, "
        "length, integer_to_binary_list, interpolate_pose, inv, list_append, list_insert, "
        "list_remove, list_extend, list_clear, log, norm, normalize, point_dist, pose_add, "
        "pose_dist, pose_inv, pose_sub, pose_trans, pow, r2d, random, rotvec2rpy, rpy2rotvec, sin, "
        "size, sqrt, tan, transpose, wrench_trans, struct, "
        "True, False, and, or, not, xor, mod, if, elif, while, return, p, run, join, kill",
    ),
    Understood(
        "function",
        f"{_MANUAL}: module interfaces",
        "get_analog_in, get_analog_out, get_configurable_digital_in, get_configurable_digital_out, "
        "get_digital_in, get_digital_out, get_euromap_input, get_euromap_output, "
        "get_standard_analog_in, get_standard_analog_out, get_standard_digital_in, "
        "get_standard_digital_out, get_tool_analog_in, get_tool_digital_in, get_tool_digital_out, "
        "modbus_add_signal, modbus_delete_signal, modbus_get_signal_status, "
        "modbus_send_custom_command, modbus_set_output_register, modbus_set_output_signal, "
        "modbus_set_runstate_dependent_choice, modbus_set_signal_update_frequency, "
        "read_input_boolean_register, read_input_float_register, read_input_integer_register, "
        "read_output_boolean_register, read_output_float_register, read_output_integer_register, "
        "read_port_bit, read_port_register, set_analog_inputrange, set_analog_out, "
        "set_analog_outputdomain, set_configurable_digital_out, set_digital_out, "
        "set_euromap_output, set_euromap_runstate_dependent_choice, "
        "set_runstate_configurable_digital_output_to_value, "
        "set_runstate_standard_analog_output_to_value, "
        "set_runstate_standard_digital_output_to_value, set_runstate_tool_digital_output_to_value, "
        "set_standard_analog_input_domain, set_standard_analog_out, set_standard_digital_out, "
        "set_tool_analog_input_domain, set_tool_communication, set_tool_digital_out, "
        "set_tool_digital_output_mode, set_tool_output_mode, set_tool_voltage, socket_close, "
        "socket_get_var, socket_open, socket_read_ascii_float, socket_read_binary_integer, "
        "socket_read_byte_list, socket_read_line, socket_read_string, socket_send_byte, "
        "socket_send_int, socket_send_line, socket_send_string, socket_set_var, "
        "write_output_boolean_register, write_output_float_register, "
        "write_output_integer_register, write_port_bit, write_port_register, zero_ftsensor, "
        "set_input_actions_to_default, set_standard_digital_input_action, "
        "set_tool_digital_input_action, set_configurable_digital_input_action, "
        "set_gp_boolean_input_action, enter_critical, exit_critical, "
        "set_safety_mode_transition_hardness",
    ),
)
_HARMLESS = understood_words(_SCRIPT_WORDS, "function")
# What is set by a call: the tool, the load, or a displacement of all positions.
_SWITCHES = {
    "set_tcp": "tcp",
    "set_payload": STATED_LOAD,
    "set_payload_mass": STATED_LOAD,
    "set_target_payload": STATED_LOAD,
    "path_offset_enable": "path_offset",
    "path_offset_disable": "path_offset",
    "track_conveyor_linear": "conveyor",
    "track_conveyor_circular": "conveyor",
    "stop_conveyor_tracking": "conveyor",
    "force_mode": "force",
    "end_force_mode": "force",
    "freedrive_mode": "freedrive",
    "end_freedrive_mode": "freedrive",
    "teach_mode": "freedrive",
    "end_teach_mode": "freedrive",
    "screw_driving": "force",
    "end_screw_driving": "force",
}
_ENDS_IT = (
    "path_offset_disable",
    "stop_conveyor_tracking",
    "end_force_mode",
    "end_freedrive_mode",
    "end_teach_mode",
    "end_screw_driving",
)
# Place of the mode among the arguments of movec, from 0: how the tool turns.
_MODE: Count = 5
_OPENS = {
    "def": "routine",
    "thread": "routine",
    "sec": "routine",
    "while": "loop",
    "for": "loop",
    "if": "branch",
}


@LANGUAGES.register
class UrScript(ControllerLanguage):
    """The language of Universal Robots."""

    name = "URScript"
    suffixes = (".script", ".urscript", ".ur")
    length = 1.0
    convention = "ur"
    in_degrees = False
    digits = (7, 8, 9)
    can_insert = True
    grammars = (nested(_TOKENS, over_lines=True),)
    understood = _SCRIPT_WORDS

    def read(self, sources: Sequence[Source]) -> Program:
        draft = Draft(sources)
        files = [_code(source) for source in sources]
        files = followed(files, outside=frozenset({POSITIONS}), ends=_ends_displacement)
        switched = {name for code in files for step in code.steps for name in step.sets}
        displaced = sorted({POSITIONS, *switched} - {"tcp", STATED_LOAD})
        entries = Entries(files, _ends_displacement)
        for i, code in enumerate(files):
            # Arguments are passed by value.
            harmless = frozenset(
                name for statement in code.statements for name, _ in calls_in(statement.items)
            )
            reader = _ScriptReader(draft, i, code, harmless, entries, self, displaced)
            for k in range(len(code.statements)):
                reader.statement(k)
        return draft.finish()

    def key(self, name: str) -> str:
        return name

    def statement(
        self, motion: Motion, source: Source, *, values: np.ndarray, posture: Posture
    ) -> str:
        start, end = motion.span
        pose = ",".join(f"{value:.{7 if k < 3 else 8}f}" for k, value in enumerate(values))
        return (
            source.text[motion.statement.start : start]
            + f"p[{pose}]"
            + source.text[end : motion.statement.end]
        )


@dataclass(frozen=True)
class _ScriptReader(Reader):
    """Reads one file; ``displacements`` are the kinds that any of the files uses."""

    language: UrScript
    displacements: Sequence[str]
    case = True

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the pose or the joint positions that items state in numbers."""
        is_pose = len(items) == 2 and is_token(items[0], "WORD") and str(items[0]) == "p"
        group = aggregate(items[1:] if is_pose else items, "[")
        numbers = numbers_of(group.parts) if group is not None else None
        if numbers is None or len(numbers) != 6:
            return None
        return Point(name, self.file, line, "pose" if is_pose else "joints", numbers)

    def statement(self, k: int) -> None:
        """Note what a statement sets or moves."""
        statement = self.statements[k]
        known = self.flow[k]
        items = statement.items
        line = statement.line
        call = call_of(statement.items)
        if call is not None and call[0] in _MOTIONS:
            self._move(k, *call)
            return
        if call is not None and call[0] in _ENDLESS:
            lost = self.skip(
                f"{call[0]} of line {line}", line, "a motion without an end point of its own"
            )
            self.draft.motions.append(Motion("joint", (lost,), statement, self.file, run=known.run))
        rest = items[1:] if is_token(items[0], "WORD", "GLOBAL", "LOCAL") else items
        sides = split(rest, "=")
        name, is_part = element_name(sides[0], case=True)
        if len(sides) == 2 and name and not self.steps[k].opens:
            self.assign(line, name, is_part, sides[1])
        elif not self.steps[k].routine:
            self.draft.read(self.words(items))

    def assign(self, line: int, name: str, is_part: bool, value: Sequence[Any]) -> None:
        """Note the value that a name is set to, perhaps a list of poses."""
        group = aggregate(value, "[")
        if (
            group is not None
            and not is_part
            and "[" not in name
            and self.literal(line, name, value) is None
        ):
            points = [
                self.literal(line, f"{name}[{k}]", part) for k, part in enumerate(group.parts)
            ]
            if all(isinstance(point, Point) for point in points):
                for point in points:
                    self.draft.declare(point)  # type: ignore[arg-type]
                return
        if "[" in name:
            # An element of a pose is a part of it, an element of a list is a pose.
            self.draft.write(name.partition("[")[0], f"line {line} sets a part of it")
        super().assign(line, name, is_part or "[" in name, value)

    def target(self, k: int, part: Sequence[Any]) -> str | Point | Skipped:
        """Return the target of a motion, perhaps by inverse kinematics near joint positions."""
        call = call_of(part)
        if call is None or call[0] != "get_inverse_kin" or not call[1].items:
            return super().target(k, part)
        target, *others = call[1].parts
        near = [name for other in others for name in sorted(self.words(other)) if name != "qnear"]
        self.draft.read(near)
        found = super().target(k, target)
        if near and isinstance(found, str):
            self.draft.near[found] = near[-1]
        return found

    def _move(self, k: int, called: str, arguments: Brackets) -> None:
        """Note a motion."""
        statement = self.statements[k]
        known = self.flow[k]
        given = _arguments(arguments)
        path = _MOTIONS[called]
        count = 2 if path == "circle" else 1
        places = given.places(count)
        if len(places) < count:
            self.not_understood(called, statement.line)
            return
        targets = tuple(self.target(k, part) for part in places)
        if path == "circle" and given.mode not in ("", "0"):
            why = f"line {statement.line} does not turn the tool to its orientation (mode)"
            targets = (targets[0], self.left(targets[1], why))
        displaced = self.displaced(k, self.displacements)
        self.draft.motions.append(
            Motion(
                path,
                targets,
                statement,
                self.file,
                self._tool(known),
                Frame("", reason=displaced) if displaced else Frame("base", np.eye(4)),
                place_of(places[-1]),
                known.run,
                path == "line",
                load=self.load(k),
                displaced=displaced,
            )
        )

    def mass(self, statement: Statement) -> float | None:
        call = call_of(statement.items)
        number = number_of(call[1].parts[0]) if call is not None and call[1].parts else None
        return number.value if number is not None else None

    def _tool(self, known: InForce) -> Frame:
        """Return the tool in force before a statement."""
        found = known.setters.get("tcp")
        if not isinstance(found, int):
            return Frame("tcp", reason=f"set_tcp: {found}" if found is not None else "")
        call = call_of(self.statements[found].items)
        point = (
            self.literal(0, "tcp", call[1].parts[0]) if call is not None and call[1].parts else None
        )
        if isinstance(point, Point) and not self.language.is_pose(point.values):
            return Frame("tcp", reason=f"line {self.statements[found].line} sets what is no pose")
        if isinstance(point, Point) and point.kind == "pose":
            return Frame("tcp", self.language.pose(point.values))
        return Frame("tcp", reason=f"line {self.statements[found].line} sets a computed tool")


@dataclass(frozen=True)
class _ScriptArguments:
    """The arguments of a motion: those without names in their order, and the others by their
    names.
    """

    plain: Sequence[Sequence[Any]]
    named: Mapping[str, Sequence[Any]]

    def places(self, count: int) -> Sequence[Sequence[Any]]:
        """Return the places of a motion through some number of them; fewer if it has not as
        many.
        """
        if len(self.plain) >= count:
            return self.plain[:count]
        names = ("pose_via", "pose_to", "pose", "q")
        return [self.named[name] for name in names if name in self.named]

    @property
    def mode(self) -> str:
        """How a circle turns the tool; "" if it is not stated."""
        is_plain = len(self.plain) > _MODE
        return text_of_items(self.plain[_MODE] if is_plain else self.named.get("mode", ()))


def _arguments(brackets: Brackets) -> _ScriptArguments:
    """Return the arguments in brackets."""
    named = dict[str, Sequence[Any]]()
    plain = []
    for part in brackets.parts:
        if len(part) > 2 and is_token(part[1], "SIGN", "="):
            named[str(part[0])] = part[2:]
        elif part:
            plain.append(part)
    return _ScriptArguments(plain, named)


def _code(source: Source) -> Code:
    """Return the statements of a file with their effects.

    Raises:
        ProgramError: for text in another language.
    """
    statements = source.statements(_TOKENS, _WORDS, over_lines=True)
    steps = [_step(statement) for statement in statements]
    if not any(
        step.opens or call_of(statement.items) is not None
        for statement, step in zip(statements, steps, strict=True)
    ):
        raise source.error(f"no statement that calls or defines anything; expected {_WORDS}", 0)
    return Code(source, statements, steps)


def _ends_displacement(statement: Statement) -> bool:
    """Return whether a statement of ``_SWITCHES`` ends what it switches."""
    return str(statement.items[0]) in _ENDS_IT


def _called(items: Sequence[Any]) -> Iterator[str]:
    """Yield the names of functions of the controller that items call at any depth: not those
    behind a point, which are run by another computer (rpc_factory).
    """
    for k, item in enumerate(items):
        if not isinstance(item, Brackets):
            continue
        is_call = item.kind == "(" and k > 0 and is_token(items[k - 1], "WORD")
        if is_call and not (k > 1 and is_token(items[k - 2], "SIGN", ".")):
            yield str(items[k - 1])
        yield from _called(item.items)


def _step(statement: Statement) -> Step:
    """Return the effect of a statement on the control flow and the tool."""
    items = statement.items
    first = str(items[0]) if is_token(items[0], "WORD") else ""
    kind = _OPENS.get(first, "")
    calls = tuple(
        name
        for name in _called(items)
        if name not in _HARMLESS
        and name not in _SWITCHES
        and name not in _MOTIONS
        and name not in _ENDLESS
    )
    if kind == "routine":
        name = next((str(item) for item in items[1:] if is_token(item, "WORD")), first)
        # A thread runs in parallel with all that follows.
        return Step(opens=first, routine=name, starts=(name,) if first == "thread" else ())
    if kind:
        return Step(opens=first, is_loop=kind == "loop", calls=calls)
    if first == "end" and len(items) == 1:
        return Step(closes=tuple(_OPENS))
    if first in ("elif", "else"):
        return Step(is_jump=True, calls=calls)
    return Step(
        sets=frozenset({_SWITCHES[first]}) if first in _SWITCHES else frozenset(), calls=calls
    )
