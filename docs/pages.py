"""Make the pages that the program itself knows best: commands, files, effects and names of the API.

``python docs/pages.py`` writes them into ``docs/reference``; a test holds them to the program.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import click
from griffe import Docstring, DocstringAttribute, DocstringSectionKind
from msgspec.inspect import DataclassType, NamedTupleType, StructType, TypedDictType, type_info

import pincal
from pincal.cli import pincal as command
from pincal.cli.arguments import Verb
from pincal.programs.language import LANGUAGES
from pincal.schemas import schema_of, structure_of
from pincal.sensors.registry import SENSORS

sys.path.insert(0, str(Path(__file__).parent))
from signatures import ALIKE, Signature, draw, own_effects, signatures

REFERENCE = Path(__file__).parent / "reference"
# What a user meets of each file.
_FILES = {
    "model": ("model.json", "The calibrated robot: predicts without its URDF. Written by every command that fits."),
    "result": ("result.json", "Results of a calibration. Written by `calibrate` and `discover`."),
    "discovery": ("discovery.json", "Missing effects and their alternatives. Written by `discover`."),
    "checks": (
        "model.checks.json",
        "Interim checks of a calibrated robot, beside its model. Written by `interim`, read by `measure` and `certificate`.",
    ),
    "diagnosis": ("diagnosis.json", "Whether the robot has changed, and what. Written by `diagnose`."),
    "measured": ("measured.json", "What the robot measured of a part. Written by `measure`."),
    "information": (
        "INFORMATION.json",
        "The information of a fit's rows on a robot: written by `fit.information.save(PATH)`, summed by "
        "`pincal.load_information`.",
    ),
    "type": (
        "TYPE.json",
        "A type of robot, written by `pincal fleet learn`: mean and spread of its machines. It has no data of single "
        "machines.",
    ),
    "camera": ("CAMERA.json", "A camera's parameters, as `--camera` takes and `simulate --camera-out` writes them."),
}
# What the sources of effects are called in full.
_SOURCES = (
    "Atkeson, An, Hollerbach (1986): Estimation of inertial parameters of manipulator loads and links. "
    "International Journal "
    "of Robotics Research 5.",
    "Baluev (2008): Assessing the statistical significance of periodogram peaks. Monthly Notices of the RAS 385.",
    "de Boor (1978): A Practical Guide to Splines. Springer.",
    "Denavit, Hartenberg (1955): A kinematic notation for lower-pair mechanisms based on matrices. Journal of Applied "
    "Mechanics 22.",
    "Furgale, Rehder, Siegwart (2013): Unified temporal and spatial calibration for multi-sensor systems. IEEE/RSJ "
    "International Conference on Intelligent Robots and Systems.",
    "Hayati (1983): Robot arm geometric link parameter estimation. IEEE Conference on Decision and Control.",
    "Heisel, Richter, Wurst (1997): Thermal behaviour of industrial robots and possibilities for error compensation. CIRP "
    "Annals 46.",
    "Heydemann (1981): Determination and correction of quadrature fringe measurement errors in interferometers. Applied "
    "Optics 20.",
    "ISO 230-7 (axes of rotation), ISO 9283 (performance of industrial robots), ISO 10360-10 (laser trackers).",
    "Judd, Knasinski (1990): A technique to calibrate industrial robots with experimental verification. "
    "IEEE Transactions on "
    "Robotics and Automation 6.",
    "Klimchik, Wu, Dumas, Caro, Furet, Pashkevich (2013): Identification of geometrical and elastostatic "
    "parameters of heavy "
    "industrial robots. [arXiv 1311.6810](https://arxiv.org/abs/1311.6810).",
    "Lightcap, Hamner, Schmitz, Banks (2008): Improved positioning accuracy of the PA10-6CE robot with geometric and "
    "flexibility calibration. IEEE Transactions on Robotics 24.",
    "Muralikrishnan, Sawyer, Blackburn, Phillips, Borchardt, Estler (2009): ASME B89.4.19 performance evaluation tests and "
    "geometric misalignments in laser trackers. Journal of Research of NIST 114.",
    "Nubiola, Bonev (2013): Absolute calibration of an ABB IRB 1600 robot using a laser tracker. Robotics and "
    "Computer-Integrated Manufacturing 29.",
    "Radkhah, Hemker, Friedmann, von Stryk: Towards the deployment of industrial robots as measurement instruments.",
    "Ruderman, Hoffmann, Bertram (2009): Modeling and identification of elastic robot joints with hysteresis and backlash. "
    "IEEE Transactions on Industrial Electronics 56.",
    "Siciliano, Sciavicco, Villani, Oriolo (2009): Robotics: Modelling, Planning and Control. Springer.",
    "Slamani, Nubiola, Bonev (2012): Modeling and assessment of the backlash error of an industrial robot. Robotica 30.",
    "Tuttle (1992): Understanding and modeling the behavior of a harmonic drive gear transmission. MIT AI Laboratory.",
    "Whitney, Lozinski, Rourke (1986): Industrial robot forward calibration method and results. Journal of Dynamic Systems, "
    "Measurement, and Control 108.",
)


def commands() -> Iterator[str]:
    """Yield the page of commands: the help text of each."""
    yield "# Commands"
    yield (
        "The output of `pincal COMMAND --help all`. Results go to stdout, progress and notes to stderr; `--json` is for "
        "programs."
    )
    settings = command.context_settings | {"max_content_width": None, "terminal_width": 100}
    with click.Context(command, info_name="pincal", **settings) as context:
        yield _block(command.get_help(context))
        yield from _verbs(command, context)


def _verbs(group: click.Group, context: click.Context, before: str = "") -> Iterator[str]:
    """Yield the help text of each command of a group, and of those of groups in it."""
    for name in group.list_commands(context):
        verb = group.get_command(context, name)
        assert verb is not None
        with click.Context(verb, info_name=name, parent=context, terminal_width=100) as own:
            yield f"## {before}{name}"
            yield _block(verb.full_help(own) if isinstance(verb, Verb) else verb.get_help(own))
            if isinstance(verb, click.Group):
                yield from _verbs(verb, own, f"{name} ")


def files() -> Iterator[str]:
    """Yield the page of files, from their schemas and from the sensors."""
    yield "# Files"
    yield (
        "Tables of measurements, and the files that pincal writes. Values are in SI units unless a name says otherwise "
        "(`_mm`, `_mrad`, or `x [mm]` in the header of a table). JSON Schemas come with the package, in `pincal/schemas`."
    )
    yield "## Tables of measurements"
    yield (
        "Tables are CSV or other text, Excel, Parquet, or ROS recordings, with one row per measured pose. They have a "
        "column per joint, named as in the URDF, and the columns of one kind of reading. `approach_<joint>` is the "
        "direction of approach (-1, 0 or 1); with `--rows-in-order` it is the sign of the move from the row before."
    )
    rows = []
    for sensor in (cls for cls in SENSORS.known().values() if cls.__module__.startswith("pincal.")):
        columns = " ".join(f"`{column}`" for field in sensor.fields for column in field.columns)
        rows.append((f"`{sensor.kind}`", columns, _first_sentence(sensor)))
    yield _table(("kind of reading", "columns", "quantity"), rows)
    told: set[type] = set()
    for key, (name, about) in _FILES.items():
        yield f"## {name}"
        yield about
        yield from _structures(schema_of(key), structure_of(key), told)


def _structures(schema: Mapping[str, Any], top: type, told: set[type]) -> Iterator[str]:
    """Yield a table for each structure of a schema, that of the file first; those of earlier files are told already."""
    structures, classes = schema["$defs"], {cls.__name__: cls for cls in _classes(type_info(top))}
    names = [name for name, structure in structures.items() if "properties" in structure and classes[name] not in told]
    for name in sorted(names, key=lambda name: name != top.__name__):
        structure, cls = structures[name], classes[name]
        told.add(cls)
        if cls is not top:
            yield f"### {name}"
            yield _described(cls)[0].replace("None", "null")
        meanings, required = meanings_of(cls), structure.get("required", ())
        rows = [
            (f"`{key}`", _kind(kind) + ("" if key in required else ", optional"), meanings[key].replace("None", "null"))
            for key, kind in structure["properties"].items()
        ]
        yield _table(("key", "type", "meaning"), rows)


def meanings_of(cls: type) -> dict[str, str]:
    """Return what the docstrings of a class, of those it inherits from and of those it refers to say of its keys."""
    meanings: dict[str, str] = {}
    for inherited in reversed(cls.__mro__):
        for place in re.findall(r"see :class:`([\w.]+)\.(\w+)`", inherited.__doc__ or ""):
            meanings |= meanings_of(getattr(importlib.import_module(place[0]), place[1]))
        meanings |= _described(inherited)[1]
    return meanings


def _classes(kind: Any) -> Iterator[type]:
    """Yield the class of every structure in a type, as msgspec describes it."""
    if isinstance(kind, StructType | TypedDictType | DataclassType | NamedTupleType):
        yield kind.cls
        for field in kind.fields:
            yield from _classes(field.type)
    else:
        inner = [getattr(kind, name) for name in ("item_type", "value_type") if hasattr(kind, name)]
        for part in (*inner, *getattr(kind, "types", ()), *getattr(kind, "item_types", ())):
            yield from _classes(part)


def _kind(kind: Mapping[str, Any]) -> str:
    """Return the type of a schema's property in words."""
    if "$ref" in kind:
        return kind["$ref"].rsplit("/", 1)[1]
    if "anyOf" in kind:
        return " or ".join(_kind(part) for part in kind["anyOf"])
    if "enum" in kind:
        return " or ".join(f"`{value}`" for value in kind["enum"])
    if kind.get("type") == "array":
        parts = kind.get("prefixItems") or [kind.get("items", {})]
        return "list of " + ", ".join(_kind(part) for part in parts if isinstance(part, Mapping))
    if kind.get("type") == "object":
        inner = kind.get("additionalProperties")
        return "object of " + _kind(inner) if isinstance(inner, Mapping) and inner else "object"
    named = kind.get("type", "any")
    return " or ".join(named) if isinstance(named, list) else str(named)


def effects() -> Iterator[str]:
    """Yield the page of effects, from what each says of itself."""
    yield "# Effects"
    yield (
        "An effect is one physical cause of error with its own parameters. The arm's coordinates are sums over effects, so "
        "that the order of effects has no meaning. The names are used in `--add`, `model.json`, `discovery.json` and "
        "`diagnosis.json`."
    )
    yield (
        "Each section defines the effect and its parameters, and gives its **signature**, drawn for a KUKA KR 125/2 in 400 "
        "random poses with random loads and temperatures, scaled to move the target by 0.1 mm rms; its **look-alikes** in "
        "the same poses, given geometry and elasticity; the measurement that **distinguishes it** from them; and its "
        "**source**. In your poses, look-alikes may differ: `discovery.json` lists them."
    )
    families: dict[str, list[tuple[str, str]]] = {}
    for name, cls in own_effects().items():
        families.setdefault(cls.family.value, []).append((f"[`{name}`](#{name})", cls.meaning))
    for family, rows in families.items():
        yield f"**{family[0].upper()}{family[1:]}**"
        yield _table(("effect", "meaning"), rows)
    for name, cls in own_effects().items():
        yield f"## {name}"
        yield f"*{cls.meaning[0].upper()}{cls.meaning[1:]}.*"
        *about, apart, source = _told(cls)
        yield from about
        yield from _seen(name, signatures().get(name))
        yield from (apart, source)
    yield "## Sources"
    yield "\n".join(f"- {source}" for source in _SOURCES)


def _seen(name: str, signature: Signature | None) -> Iterator[str]:
    """Yield how an effect shows, and what else would look like it."""
    if signature is None:
        yield "**Signature** and **look-alikes**: those of the actual cause."
        return
    needs = " and ".join(f"`{column}`" for column in signature.effect.needs)
    yield f"**Signature**: {signature.what}." + (f" It is observable only in tables with {needs}." if needs else "")
    yield f"![{name}: {signature.what}](../pictures/effects/{name}.png)"
    if signature.alike:
        others = [f"[`{other}`](#{other}) ({_share(share)})" for other, share in signature.alike]
        yield "**Look-alikes**, with the share of the signal that each could explain: " + "; ".join(others) + "."
    elif signature.is_constant:
        yield "**Look-alikes**: other constants of arm, base and tool; see below for how to distinguish them."
    else:
        yield f"**Look-alikes**: none could explain more than {round(100 * ALIKE)} % of it in these poses."


def _share(share: float) -> str:
    return "all" if share > 0.95 else f"{round(10 * share)}0 %"


def _told(cls: type) -> Iterator[str]:
    """Yield a class's docstring as Markdown; what tells it apart and its source come last."""
    told = {}
    for section in Docstring(inspect.getdoc(cls) or "").parse("google", warnings=False):
        if section.kind is DocstringSectionKind.text:
            yield _plain(section.value.strip())
        elif section.kind is DocstringSectionKind.attributes:
            yield "\n".join(f"- `{', '.join(_names(entry))}`: {_one_line(entry.description)}" for entry in section.value)
        elif section.kind is DocstringSectionKind.admonition:
            words = _one_line(section.value.contents)
            told[section.title] = f"**{section.title}**: {words}"
    yield from (told["Distinguished by"], told["Source"])


def programs() -> Iterator[str]:
    """Yield the page of the words that the readers of programs understand."""
    yield "# Words of programs"
    yield (
        "`pincal compensate` corrects the points of a [program](../guide/programs.md) behind these words: by their manuals "
        "they change neither where a point is reached nor a tool or a base. Any other instruction, option of a motion or "
        "system variable leaves the points that it can reach. What displaces points by its manual, and what ends that, is "
        "in the guide."
    )
    kinds = {
        "instruction": "instructions",
        "option": "options of a motion",
        "variable": "what may be assigned to",
        "function": "functions and words before brackets",
        "filler": "functions that change at most their arguments",
    }
    for name, language in sorted(LANGUAGES.known().items()):
        if not language.__module__.startswith("pincal.programs."):
            continue
        yield f"## {name}"
        for one in language.understood:
            yield f"**{kinds[one.kind][0].upper()}{kinds[one.kind][1:]}** ({one.source})"
            yield ", ".join(f"`{word.strip()}`" for word in one.words.split(",") if word.strip())


def names() -> Iterator[str]:
    """Yield the page of the Python API: every public name with its page, topic by topic, and where others have moved."""
    yield "# Python"
    yield (
        "The names of `import pincal`, topic by topic. Angles are in radians, lengths in metres, unless a name says "
        "otherwise. [From Python](../guide/python.md) shows them at work; what is more special stands in the modules."
    )
    public = {topic: found for topic, found in pincal._topics().items() if topic != pincal._MOVED}
    for topic, found in public.items():
        page = f"python/{_slug(topic)}.md"
        yield f"## {topic}"
        rows = [(f"[`{name}`]({page}#{name.lower()})", _first_sentence(getattr(pincal, name))) for name in found]
        yield _table(("name", "what it is"), [row for row in rows if not row[0][2:].split("`")[0].isupper()])
        if constants := [name for name in found if name.isupper()]:
            values = (f"`{name}` ({', '.join(f'`{e.name}`' for e in getattr(pincal, name))})" for name in constants)
            yield f"Effects of a model: {' and '.join(values)}."
    yield "## Moved to their modules"
    yield "These names of `import pincal` work for one more release, with a `DeprecationWarning`."
    yield _table(("name", "module"), [(f"`{name}`", f"`{home}`") for name, home in pincal._topics()[pincal._MOVED].items()])
    pages = "\n".join(f"python/{_slug(topic)}" for topic in public)
    yield f"```{{toctree}}\n:hidden:\n\n{pages}\n```"


def names_of(topic: str) -> Iterator[str]:
    """Yield the page of a topic of the Python API: each of its names with its docstring."""
    yield f"# {topic}"
    for name, home in pincal._topics()[topic].items():
        if name.isupper():
            continue
        found = getattr(pincal, name)
        yield f"## {name}"
        directive = "autoclass" if inspect.isclass(found) else "autofunction" if inspect.isfunction(found) else "autodata"
        members = "\n   :members:" if inspect.isclass(found) else ""
        yield f"```{{eval-rst}}\n.. {directive}:: {home}.{name}{members}\n```"


def _slug(topic: str) -> str:
    """Return the file name of a topic's page.

    Example:
        >>> _slug("Robots, tables and conditions")
        'robots-tables-and-conditions'
    """
    return "-".join(re.findall(r"\w+", topic.lower()))


def _described(cls: type) -> tuple[str, dict[str, str]]:
    """Return the first paragraph of a class's docstring, and what it says of each attribute."""
    summary, meanings = "", {}
    for section in Docstring(inspect.cleandoc(cls.__doc__ or "")).parse("google", warnings=False):
        if section.kind is DocstringSectionKind.text and not summary:
            summary = _one_line(section.value.split("\n\n")[0])
        elif section.kind is DocstringSectionKind.attributes:
            for entry in section.value:
                meanings |= dict.fromkeys(_names(entry), _one_line(entry.description))
    return summary, meanings


def _names(entry: DocstringAttribute) -> list[str]:
    """Return the names of an entry ``a, b: what they are``, of which griffe takes the others for the type."""
    return re.findall(r"\w+", f"{entry.name} {entry.annotation}" if entry.name.endswith(",") else entry.name)


def _first_sentence(found: Any) -> str:
    return _one_line((inspect.getdoc(found) or "").split("\n\n")[0])


def _one_line(text: str) -> str:
    """Return text without line breaks, as Markdown."""
    return _plain(" ".join(text.split()))


def _plain(text: str) -> str:
    """Return text whose formulas and references between docstrings are those of Markdown."""
    text = re.sub(r"^ *\.\. math:: *(.*(?:\n +.*)*)", r"$$\1$$", text, flags=re.MULTILINE)
    text = re.sub(r":math:`([^`]*)`", r"$\1$", text)
    return re.sub(r":\w+:`~?([^`]*)`", r"`\1`", text)


def _block(text: str) -> str:
    return f"```\n{text.rstrip()}\n```"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines)


PAGES: dict[str, Callable[[], Iterator[str]]] = {
    "commands.md": commands,
    "files.md": files,
    "effects.md": effects,
    "programs.md": programs,
    "python.md": names,
    **{f"python/{_slug(topic)}.md": partial(names_of, topic) for topic in pincal._topics() if topic != pincal._MOVED},
}


def text_of(page: str) -> str:
    """Return the text of a page."""
    mark = "<!-- Made by docs/pages.py; a test holds it to the program. -->"
    return "\n\n".join([mark, *PAGES[page]()]) + "\n"


def main() -> int:
    """Write the pages, or with ``--check`` say which are not those of the program."""
    stale = [page for page in PAGES if not (file := REFERENCE / page).exists() or file.read_text("utf-8") != text_of(page)]
    if "--check" in sys.argv[1:]:
        print("".join(f"docs/reference/{page} is not up to date; run python docs/pages.py\n" for page in stale), end="")
        return int(bool(stale))
    for page in stale:
        (REFERENCE / page).parent.mkdir(exist_ok=True)
        (REFERENCE / page).write_text(text_of(page), encoding="utf-8")
    if "effects.md" in stale:
        draw()
    return 0


if __name__ == "__main__":
    sys.exit(main())
