"""Reading and validating a URDF: anything but a tree of links and joints is refused, with location
and reason.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from pincal.errors import RobotFileError, nearest_first, needed, warn
from pincal.robot.packages import neighbouring_packages, packages_of_ros
from pincal.robot.robot_numbers import OF_ROBOT
from pincal.robot.tree import MOVING_TYPES, Mimic, UrdfJoint, UrdfTree, in_tree_order, known_links
from pincal.robot.urdf_loops import cut_loops, take_loops
from pincal.thresholds import Count, Scale
from pincal.units import LARGEST, plain_numbers

_UNSUPPORTED_TYPES = ("planar", "floating")
# Pinocchio's name of the world.
_RESERVED = "universe"
# The namespace in files that xacro has to expand.
_NAMESPACE = "xacro"
# Longest part of xacro's error message that is passed on, as it lists every macro involved.
_LONGEST: Count = 600
# Names that a message proposes, and how similar they have to be [ratio].
_NEAR: Count = 3
_ALIKE: Scale = 0.75
# Endings of descriptions of robots.
_URDF_ENDINGS = (".urdf", ".xacro", ".xml")


def parse_xml(text: bytes, source: str) -> Any:
    """Parse XML with entities, network and external files disabled.

    Raises:
        RobotFileError: if the text is not XML, declares entities, or its root is not ``<robot>``.
    """
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=False,
    )
    try:
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        expected = "expected a URDF file"
        if text.lstrip().startswith(b"{"):
            expected += "; beside a model.json stands its calibrated.urdf"
        elif Path(source).suffix and Path(source).suffix.lower() not in _URDF_ENDINGS:
            expected += " here: are robot and table in each other's place?"
        raise RobotFileError(f"{source}: not XML ({error}); {expected}") from None
    dtd = root.getroottree().docinfo.internalDTD
    if dtd is not None and any(True for _ in dtd.iterentities()):
        raise RobotFileError(
            f"{source}: declares XML entities, which are refused; expand them in the file first"
        )
    if root.tag != "robot":
        raise RobotFileError(f"{source}: root element is <{root.tag}>, expected <robot>")
    return root


def arm_text(text: bytes, moving: Collection[str], source: str, *, loops: bool = False) -> str:
    """Return the XML of an arm in which all joints but the ``moving`` ones are fixed at zero.

    With ``loops`` it includes the joints that close loops, so that it is not a tree. It declares no
    encoding, for readers that support only one.
    """
    root = parse_xml(text, source)
    closing = cut_loops(root)
    for joint in root.iterfind("joint"):
        if joint.get("name") not in moving:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    root.extend(closing if loops else [])
    return str(etree.tostring(root, encoding="unicode"))


@contextlib.contextmanager
def silent_yourdfpy() -> Iterator[None]:
    """Let yourdfpy not log, of meshes that it does not find and colours that are not declared:
    they are not needed where only joints are read or written.
    """
    logger = logging.getLogger("yourdfpy.urdf")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def written_by_yourdfpy(source: Any) -> Any:
    """Return the text of a robot that yourdfpy has read; anything else as it is.

    Raises:
        RobotFileError: if yourdfpy can't write it.
    """
    # Whoever has such an object has imported its library.
    library = sys.modules.get("yourdfpy")
    if library is None or not isinstance(source, library.URDF):
        return source
    try:
        with silent_yourdfpy():
            return bytes(source.write_xml_string())
    except Exception as error:  # The library of others may raise anything for its object.
        raise RobotFileError(
            f"yourdfpy.URDF: can't be written by yourdfpy ({type(error).__name__}: {error}); give "
            "the file"
        ) from None


def read_urdf(
    path: str | os.PathLike[str], *, xacro_args: Mapping[str, str] | None = None
) -> UrdfTree:
    """Read and check a URDF file, which may be written as xacro.

    Args:
        path: the file.
        xacro_args: values of the arguments of a xacro file.

    Raises:
        RobotFileError: if the file can't be read or expanded, is not XML, or is not a tree of links
            with finite numbers; or if arguments are given for a file that is not xacro.
    """
    source = os.fspath(path)
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise RobotFileError(
            f"{source}: can't be read ({error.strerror}); expected a URDF file"
        ) from None
    if elements := _xacro_elements(text):
        text = _expand_xacro(Path(path), elements, xacro_args or {})
    elif xacro_args:
        raise RobotFileError(
            f"{source}: is not a xacro file, so it takes no xacro arguments; leave them out"
        )
    return parse_urdf(text, source=source)


def robot_name(path: Path) -> str | None:
    """Return the name of a file's robot without parsing the rest; None if the file contains no
    robot.
    """
    try:
        with path.open("rb") as file:
            _, root = next(
                iter(
                    etree.iterparse(
                        file, events=("start",), resolve_entities=False, no_network=True
                    )
                )
            )
    except (OSError, etree.XMLSyntaxError, StopIteration):
        return None
    return root.get("name") if root.tag == "robot" else None


def parse_urdf(text: bytes, *, source: str = "URDF") -> UrdfTree:
    """Check the text of a URDF; see :func:`read_urdf`."""
    root = parse_xml(text, source)
    links = tuple(_attribute(link, "name", source) for link in root.iterfind("link"))
    joints = tuple(_read_joint(element, source) for element in root.iterfind("joint"))
    _check_names(links, "link", source)
    _check_names([joint.name for joint in joints], "joint", source)
    if not root.get("name"):
        raise _fault(root, source, '<robot> has no name; expected <robot name="...">')
    _check_origins(root, source)
    _check_masses(root, source)
    notes = tuple(_settle_axes(root, source))
    text = etree.tostring(root) if notes else text
    closures = tuple(take_loops(root, links, source))
    left = {element.get("name") for element in root.iterfind("joint")}
    joints = tuple(joint for joint in joints if joint.name in left)
    return UrdfTree(
        text=text,
        name=root.get("name", "robot"),
        source=source,
        links=links,
        joints=joints,
        root=_find_root(links, joints, source),
        closures=closures,
        notes=notes,
    )


def _check_origins(root: Any, source: str) -> None:
    """Refuse an origin of a joint or an inertia that is not of finite numbers in metres."""
    for element in [*root.iterfind("joint/origin"), *root.iterfind("link/inertial/origin")]:
        _numbers(element, "xyz", source)
        _numbers(element, "rpy", source)
        if np.abs(_numbers(element, "xyz", source)).max() > LARGEST:
            raise _fault(
                element,
                source,
                f"<origin xyz={element.get('xyz')!r}> is far beyond any robot; expected metres",
            )


def _settle_axes(root: Any, source: str) -> Iterator[str]:
    """Complete axes without a direction, of which readers have different interpretations, and yield
    notes on them.
    """
    for joint in root.iterfind("joint"):
        axis = joint.find("axis")
        if axis is not None and axis.get("xyz") is None and joint.get("type") in MOVING_TYPES:
            axis.set("xyz", "1 0 0")
            where = f"joint {joint.get('name')} (line {axis.sourceline})"
            yield f"{where} has an <axis> without xyz; it is read as 1 0 0, the default of URDF"


def _fault(element: Any, source: str, text: str) -> RobotFileError:
    return RobotFileError(f"{source}:{element.sourceline}: {text}")


def _read_joint(element: Any, source: str) -> UrdfJoint:
    name = _attribute(element, "name", source)
    kind = _attribute(element, "type", source)
    if kind not in (*MOVING_TYPES, *_UNSUPPORTED_TYPES, "fixed"):
        expected = ", ".join((*MOVING_TYPES, "fixed"))
        raise _fault(element, source, f"joint {name!r} has type {kind!r}; expected {expected}")
    ends = []
    for role in ("parent", "child"):
        end = element.find(role)
        if end is None or not end.get("link"):
            raise _fault(element, source, f"joint {name!r} names no {role} link")
        ends.append(end.get("link"))
    axis = element.find("axis")
    mimic = element.find("mimic")
    if kind in MOVING_TYPES and axis is not None:
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(_numbers(axis, "xyz", source)))
        shortest, longest = OF_ROBOT.axis_lengths
        if not shortest < length < longest:
            what = "a zero axis" if length == 0.0 else f"an axis of length {length:.1e}"
            raise _fault(
                axis, source, f"joint {name!r} has {what}; expected a direction of length 1"
            )
    _check_limit(element, name, kind, source)
    return UrdfJoint(
        name, kind, ends[0], ends[1], None if mimic is None else _read_mimic(mimic, name, source)
    )


def _read_mimic(element: Any, name: str, source: str) -> Mimic:
    numbers = plain_numbers(
        element.get(key, default) for key, default in (("multiplier", "1"), ("offset", "0"))
    )
    if not numbers or not np.isfinite(numbers).all():
        raise _fault(
            element,
            source,
            f"joint {name!r} mimics with {dict(element.items())}; expected finite numbers",
        )
    return Mimic(name, element.get("joint", ""), *numbers)


def _check_limit(element: Any, name: str, kind: str, source: str) -> None:
    """Refuse missing limits of revolute and prismatic joints, which URDF requires, and invalid
    numbers.
    """
    limit = element.find("limit")
    if limit is None and kind in ("revolute", "prismatic"):
        hint = "add <limit lower upper effort velocity>, or make it continuous"
        raise _fault(element, source, f"joint {name!r} is {kind} and has no <limit>; {hint}")
    for key, text in () if limit is None else limit.items():
        if not plain_numbers([text]):
            raise _fault(
                limit, source, f"joint {name!r} has <limit {key}={text!r}>; expected a number"
            )


def _attribute(element: Any, key: str, source: str) -> str:
    value = element.get(key)
    if not value:
        raise _fault(element, source, f"<{element.tag}> without {key!r}; expected a value")
    return str(value)


def _numbers(element: Any, key: str, source: str) -> np.ndarray:
    text = element.get(key)
    if text is None:
        return np.array([1.0, 0.0, 0.0]) if element.tag == "axis" else np.zeros(3)
    values = np.array(plain_numbers(text.split()))
    if values.shape != (3,) or not np.isfinite(values).all():
        raise _fault(
            element, source, f"<{element.tag} {key}={text!r}>; expected three finite numbers"
        )
    return values


def _check_names(names: Sequence[str], what: str, source: str) -> None:
    """Refuse names of links or joints that occur twice, or mean something else."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise RobotFileError(
            f"{source}: {what} {twice[0]!r} is defined more than once; rename or remove one"
        )
    if _RESERVED in names:
        raise RobotFileError(
            f"{source}: {_RESERVED!r} names a {what}, but means the world to Pinocchio; rename it"
        )


def _check_masses(root: Any, source: str) -> None:
    for element in root.iterfind("link/inertial/mass"):
        link = element.getparent().getparent().get("name")
        text = element.get("value")
        if not any(0.0 <= mass < np.inf for mass in plain_numbers([text or ""])):
            raise _fault(
                element,
                source,
                f"link {link!r} has mass {text!r}; expected a number of kg that is not negative",
            )
        if element.getparent().find("inertia") is None:
            hint = "so URDF readers drop the mass; add one, of zeros if it is not known"
            raise _fault(element, source, f"link {link!r} has a mass but no <inertia>, {hint}")


def _find_root(links: tuple[str, ...], joints: tuple[UrdfJoint, ...], source: str) -> str:
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                text = (
                    f"joint {joint.name!r} names the unknown link {link!r}; "
                    f"{known_links(link, links)}"
                )
                raise RobotFileError(f"{source}: {text}")
    children = {joint.child for joint in joints}
    roots = [link for link in links if link not in children]
    if len(roots) != 1 or len(in_tree_order(roots[0], joints)) != len(joints):
        raise RobotFileError(
            f"{source}: the links do not form a single tree (roots: "
            f"{', '.join(roots) or 'none, the joints form a cycle'});"
            " expected all links to descend from one root link"
        )
    return roots[0]


def _xacro_elements(text: bytes) -> list[Any]:
    """Return the elements of a file that xacro has to expand; a declared namespace alone does not
    count.
    """
    try:
        root = etree.fromstring(
            text, etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
        )
    except etree.XMLSyntaxError:
        return []
    return [
        element
        for element in root.iter(etree.Element)
        if _NAMESPACE in (etree.QName(element).namespace or "")
    ]


def _expand_xacro(path: Path, elements: Sequence[Any], arguments: Mapping[str, str]) -> bytes:
    """Return the URDF of a xacro file with some xacro elements; ``$(find NAME)`` uses the packages
    around it.
    """
    declared = [element for element in elements if etree.QName(element).localname == "arg"]
    known = {element.get("name", ""): element.get("default") for element in declared}
    unknown = [name for name in arguments if name not in known]
    if unknown:
        takes = (
            f"its arguments: {', '.join(nearest_first(unknown, known))}" if known else "it has none"
        )
        warn(f"{path}: does not declare the xacro argument {unknown[0]!r}; {takes}")
    # The name of the robot may use an argument before the line that gives its default.
    literal = {
        name: value for name, value in known.items() if value is not None and "$" not in value
    }
    dom = _expanded_by_xacro(path, literal | dict(arguments), known)
    if not dom.getElementsByTagName("link"):
        others = (
            file
            for file in sorted(path.parent.glob("*.xacro"))
            if file != path and os.access(file, os.R_OK)
        )
        users = [
            file.name
            for file in others
            if file.is_file() and os.fsencode(path.name) in file.read_bytes()
        ]
        use = " or ".join(users) or "the file that includes it"
        raise RobotFileError(
            f"{path}: expands to no link, as it only defines macros; expected {use}"
        )
    return bytes(dom.toxml(encoding="utf-8"))


def _expanded_by_xacro(
    path: Path, values: Mapping[str, str], known: Mapping[str, str | None]
) -> Any:
    try:
        import xacro
        import xacrodoc
    except ImportError:
        raise RobotFileError(
            f"{path}: is a xacro file, and xacrodoc, which reads it, is not installed; "
            "install it (pip install 'pincal[xacro]'), or expand the file with xacro first"
        ) from None
    # A package that an earlier file had beside it is not one of this file.
    xacrodoc.packages.reset()
    xacrodoc.packages.update_package_cache(packages_of_ros() | neighbouring_packages(path))
    # Includes are relative to the including file; xacrodoc passes only the text to xacro, which
    # would resolve them in the working folder, or at the file of an earlier failure.
    xacro.init_stacks(os.fspath(path.absolute()))
    try:
        # xacro's warnings concern its own history, such as the order of evaluation.
        with contextlib.redirect_stderr(io.StringIO()):
            document = xacrodoc.XacroDoc.from_file(
                path, walk_up=False, subargs=dict(values), resolve_packages=False
            )
    except (Exception, SystemExit) as error:  # Expressions in the file may raise anything.
        if missing := re.search(r"Package not found: (\S+)", str(error)):
            raise RobotFileError(_without_package(path, missing[1])) from None
        plain = re.sub(r"<class '[\w.]+'>:?", "", str(error))
        reason = " ".join(plain.split())[:_LONGEST] or type(error).__name__
        listed = ", ".join(f"{name}:={values[name]}" if name in values else name for name in known)
        takes = f"; its arguments, to be set by --xacro-arg NAME:=VALUE: {listed}" if known else ""
        raise RobotFileError(f"{path}: xacro can't expand it ({reason}){takes}") from None
    return document.dom


def _without_package(path: Path, name: str) -> str:
    """Return what to do about a ROS package that a xacro file needs and that is not there."""
    return (
        f"{path}: needs the ROS package {name!r}, which was not found; put its folder (the one "
        "with package.xml) beside this file or beside a folder above it, or name the folder that "
        "contains it: ROS_PACKAGE_PATH=FOLDER (of an installed workspace: AMENT_PREFIX_PATH)"
    )


# Where descriptions of robots are found that example-robot-data lacks.
_ELSEWHERE = (
    "descriptions of others are published by their makers and by ROS, as packages called "
    "NAME_description (ur_description, franka_description, kuka_*_support, ...): download one and "
    "give the path of its .urdf or .urdf.xacro file"
)


def find_file(source: str | os.PathLike[str]) -> Path:
    """Return the path of a URDF given by path or by its name in example-robot-data.

    Raises:
        RobotFileError: for a name that is neither.
    """
    path = Path(source)
    # A folder with the name of a robot, such as one of results, is not a URDF.
    if path.is_file() or path.suffix or os.sep in os.fspath(source):
        return path
    what = f"{path.name!r} is not a file, and robots by name"
    package = "example-robot-data-loaders"
    with needed("example-robot-data", what, install=package, error=RobotFileError):
        from example_robot_data import robots_loader

    loaders = robots_loader.ROBOTS
    if path.name not in loaders:
        near = difflib.get_close_matches(path.name, sorted(loaders), n=_NEAR, cutoff=_ALIKE)
        meant = f" (is it {' or '.join(near)}? another robot has other dimensions)" if near else ""
        raise RobotFileError(
            f"{path.name!r} is neither a file nor a robot of example-robot-data{meant}; "
            f"expected a path to a URDF; {_ELSEWHERE}"
        )
    loader: Any = loaders[path.name]
    if not loader.urdf_filename:
        raise RobotFileError(
            f"example-robot-data has no URDF for {path.name!r}; give the path of one"
        )
    inside = Path(str(loader.path), str(loader.urdf_subpath), str(loader.urdf_filename))
    folder: str = robots_loader.getModelPath(inside.as_posix())
    return _of_this_name(path.name, Path(folder, inside), known=loaders)


def _of_this_name(name: str, file: Path, known: Collection[str]) -> Path:
    """Return the file of a robot, or a file next to it if this one has the name of another known
    robot.

    The table of example-robot-data confuses some robots: its "ur3" is the file of a UR5.
    """
    found = robot_name(file)
    # A variant, such as "panda_collision", has the name of its robot.
    if found is None or found not in known or name.startswith(found):
        return file
    conflict = (
        f"example-robot-data has {file.name} under the name {name!r}, whose robot is called "
        f"{found!r}"
    )
    other = file.with_name(file.name.replace(found, name))
    if robot_name(other) != name:
        near = ", ".join(nearest_first([name], sorted(one for one in known if one != name))[:12])
        raise RobotFileError(
            f"{conflict}; expected {name!r}: give the path of its URDF, or another name, "
            f"such as {near}"
        )
    warn(f"{conflict}; {other.name} in the same folder is read instead")
    return other
