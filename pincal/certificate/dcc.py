r"""The certificate as a digital calibration certificate (DCC) of PTB, by version 3.3.0 of its
schema.

Elements and their order are those of the schema ``https://ptb.de/dcc/v3.3.0/dcc.xsd``; quantities
are written in the digital system of units (D-SI), with units such as ``\milli\metre``. Numbers are
those of the files that the certificate is made of, digit by digit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from lxml import etree

from pincal.certificate.contents import (
    NOT_STATED,
    Budget,
    Certificate,
    Figure,
    FigureGroup,
    Range,
)
from pincal.errors import printable

DCC_VERSION = "3.3.0"
DCC = "https://ptb.de/dcc"
SI = "https://ptb.de/si"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_LANGUAGE = "en"
# Code of an unknown country; ISO 3166-1 leaves it to users.
_NOWHERE = "ZZ"
# Units of the D-SI by those of results.
_UNITS = {
    "": r"\one",
    "um": r"\micro\metre",
    "mm": r"\milli\metre",
    "m": r"\metre",
    "urad": r"\micro\radian",
    "mrad": r"\milli\radian",
    "rad": r"\radian",
    "deg": r"\degree",
    "m/s^2": r"\metre\second\tothe{-2}",
    "mrad/s": r"\milli\radian\second\tothe{-1}",
    "kg": r"\kilogram",
    "deg C": r"\degreecelsius",
}
# Decisions in the words of the schema; undecided ones depend on the value.
_CONFORMITY = {"conforms": "pass", "does not conform": "fail"}


def digital_certificate(certificate: Certificate) -> bytes:
    """Return ``dcc.xml``."""
    root = etree.Element(
        f"{{{DCC}}}digitalCalibrationCertificate",
        {
            "schemaVersion": DCC_VERSION,
            f"{{{_XSI}}}schemaLocation": f"{DCC} {DCC}/v{DCC_VERSION}/dcc.xsd",
        },
        nsmap={"dcc": DCC, "si": SI, "xsi": _XSI},
    )
    _Administrative(certificate).write(_Writer(root).inner("administrativeData"))
    _Measured(certificate).write(_Writer(root).inner("measurementResults"))
    etree.indent(root)
    return bytes(etree.tostring(root, encoding="UTF-8", xml_declaration=True, pretty_print=True))


@dataclass(frozen=True, eq=False)
class _Writer:
    """Writes elements into one."""

    element: Any

    def inner(self, name: str, *, kind: str = "") -> _Writer:
        """Add an element, with a kind by the good practice of the DCC, and return its writer."""
        made = etree.SubElement(self.element, f"{{{DCC}}}{name}")
        if kind:
            made.set("refType", kind)
        return _Writer(made)

    def line(self, name: str, text: str) -> None:
        """Add an element that holds a text, which may be from a file: XML has no characters of
        control, and the schema no blanks at the ends.
        """
        etree.SubElement(self.element, f"{{{DCC}}}{name}").text = printable(text).strip()

    def words(self, name: str, text: str) -> None:
        """Add an element that holds a text in the language of the certificate."""
        made = self.inner(name)
        made.line("content", text)
        made.element[0].set("lang", _LANGUAGE)

    def identification(self, issuer: str, value: str, name: str) -> None:
        """Add the number of something, by who issued it."""
        made = self.inner("identification")
        made.line("issuer", issuer)
        made.line("value", value)
        made.words("name", name)

    def quantity(self, name: str, value: float, unit: str, *, kind: str = "") -> _Writer:
        """Add a quantity, and return its writer."""
        made = self.inner("quantity", kind=kind)
        made.words("name", name)
        if unit in _UNITS:
            made.real(value, unit)
        else:
            # Pixels are no unit of the D-SI.
            made.words("noQuantity", f"{value!r} {unit}")
        return made

    def real(self, value: float, unit: str) -> _Writer:
        """Add a number with its unit, and return its writer."""
        real = _Writer(etree.SubElement(self.element, f"{{{SI}}}real"))
        real.number("value", value)
        etree.SubElement(real.element, f"{{{SI}}}unit").text = _UNITS[unit]
        return real

    def number(self, name: str, value: float) -> None:
        """Add an element of the D-SI that holds a number, with all its digits."""
        etree.SubElement(self.element, f"{{{SI}}}{name}").text = repr(float(value))


def _software(to: _Writer) -> None:
    """Add this program."""
    made = to.inner("software")
    made.words("name", "pincal")
    made.line("release", f"v{version('pincal')}")


@dataclass(frozen=True)
class _Administrative:
    """Who certifies what for whom."""

    of: Certificate

    def write(self, to: _Writer) -> None:
        """Write all of it, in the order of the schema."""
        _software(to.inner("dccSoftware"))
        self._core(to.inner("coreData"))
        self._item(to.inner("items").inner("item"))
        identity = self.of.identity
        self._contact(
            to.inner("calibrationLaboratory").inner("contact"), identity.laboratory, identity.place
        )
        person = to.inner("respPersons").inner("respPerson")
        person.inner("person").words("name", identity.operator or NOT_STATED)
        person.line("mainSigner", "true")
        self._contact(to.inner("customer"), identity.customer, "")
        self._statements(to.inner("statements"))

    def _core(self, to: _Writer) -> None:
        of = self.of
        issued = of.issue.day.isoformat()
        measured = of.identity.date or issued
        to.line("countryCodeISO3166_1", of.identity.country or _NOWHERE)
        to.line("usedLangCodeISO639_1", _LANGUAGE)
        to.line("mandatoryLangCodeISO639_1", _LANGUAGE)
        to.line("uniqueIdentifier", of.number)
        to.line("beginPerformanceDate", measured)
        to.line("endPerformanceDate", measured)
        to.line("performanceLocation", "other")
        to.line("issueDate", issued)

    def _item(self, to: _Writer) -> None:
        of = self.of
        serials = {"robot": of.identity.robot, "controller": of.identity.controller}
        stated = {what: serial for what, serial in serials.items() if serial}
        to.words("name", of.item)
        listed = to.inner("identifications")
        for what, serial in stated.items():
            listed.identification("manufacturer", serial, f"serial number of the {what}")
        if not stated:
            listed.identification("other", NOT_STATED, "serial number")

    def _contact(self, to: _Writer, name: str, place: str) -> None:
        to.words("name", name or NOT_STATED)
        to.inner("location").words("further", place or NOT_STATED)

    def _statements(self, to: _Writer) -> None:
        for name, text in _statements(self.of):
            made = to.inner("statement")
            made.words("name", name)
            made.words("declaration", text)
        if self.of.ranges:
            made = to.inner("statement", kind="basic_validityRange")
            made.words("declaration", "ranges within which the results are valid")
            data = made.inner("data")
            for of in self.of.ranges:
                _range(data, of)


def _range(to: _Writer, of: Range) -> None:
    """Add the ends of a range."""
    to.quantity(f"{of.name}, least", of.lower, of.unit, kind="basic_validityRangeMin")
    to.quantity(f"{of.name}, largest", of.upper, of.unit, kind="basic_validityRangeMax")


def _statements(of: Certificate) -> Iterator[tuple[str, str]]:
    """Yield statements that belong to the certificate as a whole."""
    yield "traceability", of.traceability
    if not of.identity.date:
        yield "day of the measurement", f"{NOT_STATED}; the day given is the day of issue"
    if of.identity.place:
        yield "place of the measurement", of.identity.place
    for name, text in of.identity.note.items():
        yield name, text
    for name, text in of.facts.items():
        yield name, text
    if of.verdict:
        yield "verdict", of.verdict
    for doubt in of.doubts:
        yield "doubt", doubt
    if of.rule:
        yield "decision rule", of.rule
    for name, checksum in of.files.items():
        yield f"SHA-256 of {name}", checksum
    yield from of.versions.items()


@dataclass(frozen=True)
class _Measured:
    """What was measured."""

    of: Certificate

    def write(self, to: _Writer) -> None:
        """Write the results with how they were found, in the order of the schema."""
        made = to.inner("measurementResult")
        made.words("name", self.of.title)
        self._methods(made.inner("usedMethods"))
        _software(made.inner("usedSoftware"))
        self._equipment(made)
        self._conditions(made)
        results = made.inner("results")
        for group in self.of.groups:
            _group(results.inner("result"), group)
        if self.of.budget is not None:
            _budget(results.inner("result"), self.of.budget)

    def _methods(self, to: _Writer) -> None:
        method = to.inner("usedMethod", kind="basic_uncertainty")
        method.words("name", "expanded uncertainty")
        method.words(
            "description",
            "standard uncertainty times the coverage factor; with k = 2 it holds about 95 % of "
            "the values, if these are normally distributed",
        )
        method.line("norm", "JCGM 100:2008")

    def _equipment(self, to: _Writer) -> None:
        identity = self.of.identity
        if not identity.instrument:
            return
        made = to.inner("measuringEquipments").inner("measuringEquipment")
        made.words("name", identity.instrument)
        if identity.certificate:
            made.inner("identifications").identification(
                "other", identity.certificate, "calibration certificate"
            )

    def _conditions(self, to: _Writer) -> None:
        temperature = self.of.identity.temperature
        listed = to.inner("influenceConditions")
        made = listed.inner("influenceCondition", kind="basic_temperature")
        made.words("name", "ambient temperature")
        data = made.inner("data")
        if temperature is None:
            # PTB's rules accept no result without a condition.
            data.words("text", NOT_STATED)
        else:
            data.quantity("temperature", temperature, "deg C")


def _group(to: _Writer, group: FigureGroup) -> None:
    """Add the figures of a group."""
    to.words("name", group.title)
    if group.remark:
        to.words("description", group.remark)
    data = to.inner("data")
    for figure in group.figures:
        _figure(data, figure)


def _figure(to: _Writer, of: Figure) -> None:
    """Add a figure with its uncertainty, and where it has limits whether it conforms."""
    made = to.quantity(of.name, of.value, of.unit, kind="basic_measuredValue")
    if of.expanded is not None and of.unit in _UNITS:
        real = made.element.find(f"{{{SI}}}real")
        univariate = etree.SubElement(real, f"{{{SI}}}measurementUncertaintyUnivariate")
        expanded = _Writer(etree.SubElement(univariate, f"{{{SI}}}expandedMU"))
        expanded.number("valueExpandedMU", of.expanded.value)
        expanded.number("coverageFactor", of.expanded.factor)
        expanded.number("coverageProbability", of.expanded.probability)
    if of.interval is not None and of.unit in _UNITS:
        ends = {"least": of.interval[0], "largest": of.interval[1]}
        stated = {
            f"{end} value of the 95 % interval": repr(value)
            for end, value in ends.items()
            if value is not None
        }
        if stated:
            _facts(made.inner("measurementMetaData"), stated.items())
    if of.decision is not None and of.limits is not None:
        _conformity(
            made.inner("measurementMetaData").inner("metaData", kind="basic_conformity"), of
        )
    if of.nominal is not None:
        to.quantity(f"{of.name}, nominal", of.nominal, of.unit, kind="basic_nominalValue")


def _conformity(to: _Writer, of: Figure) -> None:
    """Add the decision on a figure, and its limits."""
    assert of.limits is not None
    lower, upper = of.limits
    to.words("declaration", str(of.decision))
    # Undecided: within the limits, or beyond them, by less than the uncertainty.
    within = lower <= of.value <= upper
    undecided = "conditionalPass" if within else "conditionalFail"
    to.line("conformity", _CONFORMITY.get(str(of.decision), undecided))
    ends = {"Lower": lower, "Upper": upper}
    known = {end: value for end, value in ends.items() if math.isfinite(value)}
    if known:
        data = to.inner("data")
        for end, value in known.items():
            name = f"{end.lower()} limit"
            data.quantity(name, value, of.unit, kind=f"basic_acceptanceLimit{end}")


def _budget(to: _Writer, budget: Budget) -> None:
    """Add the standard uncertainty by each source."""
    to.words("name", "uncertainty budget")
    to.words("description", f"standard uncertainty of {budget.of}")
    data = to.inner("data")
    for line in budget.lines:
        made = data.quantity(_source(line.source, line.type), line.standard, budget.unit)
        facts = {"distribution": line.distribution, "share of the variance": repr(line.share)}
        if line.degrees is not None:
            facts["degrees of freedom"] = repr(line.degrees)
        _facts(made.inner("measurementMetaData"), facts.items())


def _source(name: str, kind: str) -> str:
    return f"{name}, type {kind}" if kind else name


def _facts(to: _Writer, facts: Iterable[tuple[str, str]]) -> None:
    """Add facts on a quantity."""
    for name, text in facts:
        made = to.inner("metaData")
        made.words("name", name)
        made.words("declaration", text)
