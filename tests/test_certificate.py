"""Certificates: their figures are those of the files that they certify, and the XML has the structure of the schema."""

from __future__ import annotations

import base64
import copy
import datetime
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from lxml import etree
from scipy import stats
from test_catalogue import EFFECTS as ALL_EFFECTS
from test_export import calibrated_of, drawn
from test_identity import STATED

from pincal import Robot
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.certificate.certificate_page import certificate_page
from pincal.certificate.contents import Certificate, Figure, FigureGroup, Issue
from pincal.certificate.dcc import DCC, DCC_VERSION, SI, digital_certificate
from pincal.certificate.of_measured import certificate_of_measured
from pincal.certificate.of_model import certificate_of_model, position_budget, source_of_lengths
from pincal.errors import BadInputError
from pincal.identity import Identity
from pincal.io.result_folder import output_folder
from pincal.model.chain import Chain
from pincal.model.effects import GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Estimate, estimate_of
from pincal.sensors.setup import KnownDistance, Setup

ISSUE = Issue(number="C-17", day=datetime.date(2026, 11, 29))
DOUBT = "the residuals are 7.64 times the declared noise"
RESULT: dict[str, Any] = {
    "noise": {"source": "declared", "sigma_m": 5e-5},
    "rows": {"train": 60, "test": 60},
    "parameters": [],
    "rank": 27,
    "condition": 16.9,
    "chi2_reduced": 1.1,
    "chi2_p_value": 0.3,
    "iterations": 6,
    "seconds": 1.5,
    "converged": True,
    "outliers": [],
    "correlations": [],
    "stages": [],
    "error": {
        "nominal": {"test": {"mean_mm": 3.581513, "rms_mm": 4.0586, "p95_mm": 7.10441, "max_mm": 8.237}},
        "calibrated": {
            "train": {"mean_mm": 0.06, "rms_mm": 0.07},
            "test": {"mean_mm": 0.0689412345678, "rms_mm": 0.0744221, "p95_mm": 0.117762, "max_mm": 0.14515},
        },
    },
    "warnings": [{"severity": "doubt", "text": DOUBT}, {"severity": "note", "text": "three rows are left out"}],
    "validation": {"way": "regions", "folds": 25},
    "intervals": {"mean_mm": [0.0613, 0.0765], "p95_mm": [0.10123, None]},
    "uncertainty": {"here_mm": 0.0512345, "anywhere_mm": 0.1123456, "k": 2.0, "rests_on": "declared noise"},
    "elsewhere": {"mean_mm": 0.2668293, "worst_mm": 0.392384, "where": "", "poses": 400, "over": ""},
    "verdict": "not adequate",
}
MEASURED: dict[str, Any] = {
    "features": [
        {
            "name": "hole_1",
            "kind": "circle",
            "values": {
                "diameter": {
                    "value": 12.0345678,
                    "unit": "mm",
                    "u": 0.021,
                    "U": 0.0423,
                    "k": 2.013,
                    "dof": 48.2,
                    "nominal": 12.0,
                    "deviation": 0.0345678,
                    "limits": [11.9, 12.1],
                    "decision": "conforms",
                },
                "x": {"value": -1e-5, "unit": "mm", "u": 0.02, "U": 0.04, "k": 2.0, "dof": None},
            },
            "form_mm": 0.031,
            "readings": 8,
            "stops": 4,
        },
        {
            "name": "edge",
            "kind": "distance",
            "values": {
                "length": {
                    "value": 100.09,
                    "unit": "mm",
                    "u": 0.02,
                    "U": 0.04,
                    "k": 2.0,
                    "dof": 60.0,
                    "nominal": 100.0,
                    "limits": [None, 100.1],
                    "decision": "undecided",
                }
            },
            "readings": 2,
            "stops": 2,
        },
    ],
    "covariance": {"names": [], "matrix": []},
    "budget": [
        {"source": "sensor", "type": "B", "u": 0.01, "dof": None, "share": 0.2},
        {"source": "parameters", "type": "A", "u": 0.02, "dof": 48.0, "share": 0.8},
    ],
    "datum": {
        "kind": "3-2-1",
        "features": ["plane", "edge"],
        "frame": "base",
        "position_mm": [0.0, 0.0, 0.0],
        "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    },
    "provenance": {"pincal": "0.1.0", "inputs": {"part.toml": "cd" * 32}},
    "rule": "ISO 14253-1, guard band U",
    "id": {"robot": "2021-17", "note": {"part": "door 4"}},
}


@pytest.fixture(scope="module")
def known(kuka: Robot) -> FittedRobot:
    """Return the KUKA with a covariance of parameters, and an identity."""
    model = Model(Chain.of(kuka), (*GEOMETRIC, BaseFrame(), ToolFrame(FRAME_SYMBOLS)))
    values = np.full(model.n_parameters, 1e-4)
    estimate = estimate_of(model.parameters, values, np.diag(values**2))
    found = calibrated_of(model, values).with_model(model, estimate)
    return replace(found, identity=STATED, provenance={"pincal": "0.1.0", "inputs": {"data.csv": "ab" * 32}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, known: FittedRobot) -> Path:
    """Return a folder as calibrate writes it."""
    made = tmp_path_factory.mktemp("calibrated")
    known.save(made / "model.json")
    (made / "result.json").write_text(json.dumps(RESULT | {"parameters": parameters_of(known)}))
    return made


def of_free(estimate: Estimate, free: np.ndarray) -> Estimate:
    """Return an estimate of which only some parameters were fitted."""
    variances = np.where(free, estimate.sigma**2, 0.0)
    return estimate_of(estimate.parameters, estimate.values, np.diag(variances))


def parameters_of(known: FittedRobot) -> list[dict[str, Any]]:
    """Return the parameters of a model as a result lists them."""
    rest = {"nominal": 0.0, "value": 1e-4, "sigma": 1e-4, "status": "identified", "reason": ""}
    return [{"name": p.name, "unit": p.unit} | rest for p in known.estimate.parameters]


@pytest.fixture(scope="module")
def of_model(folder: Path) -> Certificate:
    """Return the certificate of the robot."""
    return certificate_of_model(folder / "model.json", Identity(), ISSUE)


@pytest.fixture(scope="module")
def of_part(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    """Return the certificate of the part."""
    made = tmp_path_factory.mktemp("measured")
    (made / "measured.json").write_text(json.dumps(MEASURED))
    return certificate_of_measured(made, Identity(), ISSUE)


def quantities(xml: bytes) -> dict[str, tuple[float, str]]:
    """Return values and units of all quantities of the results, by the names of result and quantity."""
    spaces = {"dcc": DCC, "si": SI}
    found = {}
    for result in etree.fromstring(xml).iterfind(".//dcc:results/dcc:result", spaces):
        title = result.findtext("dcc:name/dcc:content", namespaces=spaces)
        for one in result.iterfind("dcc:data/dcc:quantity", spaces):
            name = one.findtext("dcc:name/dcc:content", namespaces=spaces)
            value = one.findtext("si:real/si:value", namespaces=spaces)
            unit = one.findtext("si:real/si:unit", namespaces=spaces)
            found[f"{title}: {name}"] = (float(value), unit)
    return found


def test_every_figure_of_a_model_is_in_the_digital_certificate(of_model: Certificate) -> None:
    """Values are those of result.json to the last digit."""
    found = quantities(digital_certificate(of_model))

    names = {"mean_mm": "mean", "rms_mm": "root mean square", "p95_mm": "95 % of the rows", "max_mm": "worst"}
    titles = {"calibrated": "Error of the calibrated robot", "nominal": "Error of the nominal robot, base and tool fitted"}
    for model, title in titles.items():
        for key, value in RESULT["error"][model]["test"].items():
            assert found[f"{title}: {names[key]}"] == (value, r"\milli\metre")
    elsewhere = RESULT["elsewhere"]
    title = "Uncertainty of predicted positions"
    assert found[f"{title}: expected within the joint limits, mean"][0] == elsewhere["mean_mm"]
    assert found[f"{title}: expected within the joint limits, worst"][0] == elsewhere["worst_mm"]
    assert found[f"{title}: U (k = 2) at the measured poses"][0] == RESULT["uncertainty"]["here_mm"]
    assert found[f"{title}: U (k = 2) within the joint limits"][0] == RESULT["uncertainty"]["anywhere_mm"]


def test_the_page_shows_the_figures_of_the_result(of_model: Certificate) -> None:
    """The sheet has what result.json has, rounded as everywhere, the verdict, and doubts in full but no notes."""
    page = certificate_page(of_model)

    for model in ("nominal", "calibrated"):
        for value in RESULT["error"][model]["test"].values():
            assert f"<td>{value:.4f} mm</td>" in page
    assert "<b>not adequate</b>" in page and DOUBT in page
    assert "three rows" not in page


def test_intervals_of_errors_are_those_of_the_result(of_model: Certificate) -> None:
    """Both ends where they are known; an end that so few poses do not show is left open."""
    page = certificate_page(of_model)
    xml = digital_certificate(of_model).decode()

    assert "<td>0.0613 to 0.0765</td>" in page and "<td>above 0.1012</td>" in page
    assert re.findall(r">(\w+) value of the 95 % interval<", xml) == ["least", "largest", "least"]
    assert ">0.10123<" in xml


def test_the_uncertainty_of_positions_is_twice_the_root_of_the_budget(known: FittedRobot, of_model: Certificate) -> None:
    """Shares add up to the whole, and U is k times the root of the sum of squares."""
    budget = position_budget(known)

    assert sum(line.share for line in budget.lines) == pytest.approx(1.0)
    assert position_budget(calibrated_of(known.model, known.values)).lines == ()
    combined = np.sqrt(sum(line.standard**2 for line in budget.lines))
    assert of_model.groups[-1].figures[2].value == pytest.approx(2.0 * combined)


def test_an_open_turn_of_the_base_is_no_uncertainty_of_the_arm(kuka: Robot, tmp_path: Path) -> None:
    """Contacts leave it open: the sheet has U of what they tell, and the report's figures; 2 mm were a Panda's of 0.2 mm."""
    model = Model(Chain.of(kuka), (*GEOMETRIC, BaseFrame(()), ToolFrame(FRAME_SYMBOLS[:3])))
    sigma = np.where([name == "joint_1.theta" for name in model.names], 2e-3, 1e-6)
    estimate = estimate_of(model.parameters, 0.0 * sigma, np.diag(sigma**2))
    found = calibrated_of(model, 0.0 * sigma).with_model(model, estimate)
    found.save(tmp_path / "model.json")
    of_arm = {"link": "tool0", "poses": 60, "before_mm": 2.0}
    regions = [
        of_arm | {"region": region, "after_mm": size} for region, size in (("measured poses", 0.1), ("far, low", 0.3))
    ]
    result = {key: RESULT[key] for key in RESULT if key not in ("elsewhere", "uncertainty")}
    result |= {"parameters": parameters_of(found), "improvement": regions}
    (tmp_path / "result.json").write_text(json.dumps(result))

    group = certificate_of_model(tmp_path / "model.json", Identity(), ISSUE).groups[-1]
    U, *of_report = (figure.value for figure in group.figures)

    assert "once base and target are located" in group.remark
    assert 0.0 < U < 0.02 < 2e3 * float(np.max(found.position_sigma(found.conditions_at(np.full((1, 6), 0.3)))))
    assert of_report == [0.1, 0.3]


def test_a_part_keeps_values_limits_and_decisions(of_part: Certificate) -> None:
    """The certificate of a part has the digits of measured.json, and says undecided by the words of the schema."""
    xml = digital_certificate(of_part).decode()
    found = quantities(xml.encode())

    assert found["hole_1 (circle): diameter"] == (12.0345678, r"\milli\metre")
    assert found["hole_1 (circle): x"][0] == -1e-5
    assert "<si:valueExpandedMU>0.0423<" in xml and "<si:coverageFactor>2.013<" in xml
    probabilities = re.findall(r"<si:coverageProbability>(.*?)<", xml)
    covered = (2.0 * stats.t(48.2).cdf(2.013) - 1.0, 0.9545, 2.0 * stats.t(60.0).cdf(2.0) - 1.0)
    assert [float(found) for found in probabilities] == pytest.approx(covered, abs=5e-5)
    assert found["hole_1 (circle): form"][0] == 0.031
    assert found["uncertainty budget: parameters, type A"][0] == 0.02
    assert [line.distribution for line in of_part.budget.lines] == ["t", "normal"]
    assert re.findall(r"<dcc:conformity>(\w+)<", xml) == ["pass", "conditionalPass"]
    page = certificate_page(of_part)
    assert "11.9000 to 12.1000" in page and "at most 100.1000" in page and "undecided" in page
    assert "ISO 14253-1, guard band U" in page and "door 4" in page
    assert of_part.facts["decisions"] == "conforms: 1, undecided: 1" and "-0.0000" not in page
    assert of_part.facts["datum"] == "3-2-1 by plane, edge in the frame of the base"
    assert of_part.files["part.toml"] == "cd" * 32


def test_no_uncertainty_is_said_to_be_zero(tmp_path: Path) -> None:
    """One below the last digit has a bound; what the datum holds was not measured and has none, in words and in the file."""
    measured = copy.deepcopy(MEASURED)
    values = measured["features"][0]["values"]
    values["k"] = values["x"] | {"unit": "", "value": 1.0, "nominal": 1.0, "U": 2.1e-6}
    values["y"] = values["x"] | {"value": 0.0, "U": 1.2e-10}
    (tmp_path / "measured.json").write_text(json.dumps(measured))

    certificate = certificate_of_measured(tmp_path, Identity(), ISSUE)
    page = certificate_page(certificate)
    assert "y (held by the datum)" in page and "0.0000 (k" not in page
    assert "&lt;0.0001 (k = " in page
    held = digital_certificate(certificate).decode().partition("y (held by the datum)")[2].partition("</dcc:quantity>")[0]
    assert "si:value" in held and "expandedMU" not in held


def test_a_direction_is_not_taken_for_the_coverage_factor(tmp_path: Path) -> None:
    """The components i, j, k of a unit vector are named as such, beside a U with its k."""
    measured = copy.deepcopy(MEASURED)
    values = measured["features"][0]["values"]
    values["k"] = values["x"] | {"unit": "", "value": 1.0, "nominal": 1.0}
    (tmp_path / "measured.json").write_text(json.dumps(measured))

    page = certificate_page(certificate_of_measured(tmp_path, Identity(), ISSUE))

    assert "<td>direction k</td>" in page and "<td>k</td>" not in page


# The content of elements by the published schema, versions 3.2.1 and 3.3.0 alike, as far as certificates use them:
# children in their order, as regular expressions over their names; # is text.
TEXT = "#"
WORDS = "content+"
RICH = "name? content*"
CONTENT: Mapping[str, str] = {
    "digitalCalibrationCertificate": "administrativeData measurementResults",
    "administrativeData": "dccSoftware refTypeDefinitions? coreData items calibrationLaboratory respPersons customer "
    "statements?",
    "dccSoftware": "software+",
    "software": "name release type? description?",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1+ mandatoryLangCodeISO639_1+ uniqueIdentifier identifications? "
    "receiptDate? beginPerformanceDate endPerformanceDate performanceLocation issueDate?",
    "items": "name? item+",
    "item": "name description? manufacturer? model? identifications",
    "identifications": "identification+",
    "identification": "issuer value name?",
    "calibrationLaboratory": "calibrationLaboratoryCode? contact",
    "contact": "name eMail? phone? fax? location",
    "customer": "name eMail? phone? fax? location",
    "location": "(city|countryCode|postCode|street|streetNo|further)+",
    "respPersons": "respPerson+",
    "respPerson": "person description? role? mainSigner?",
    "person": "name location?",
    "statements": "statement+",
    "statement": "name? description? norm* reference* declaration? date? conformity? data?",
    "metaData": "name? description? norm* reference* declaration? date? conformity? data?",
    "measurementResults": "measurementResult+",
    "measurementResult": "name description? usedMethods? usedSoftware? measuringEquipments? influenceConditions? results "
    "measurementMetaData?",
    "usedMethods": "usedMethod+",
    "usedMethod": "name description? norm* reference*",
    "measuringEquipments": "name? measuringEquipment+",
    "measuringEquipment": "name description? manufacturer? model? identifications?",
    "influenceConditions": "influenceCondition+",
    "influenceCondition": "name description? status? data",
    "results": "result+",
    "result": "name description? data",
    "data": "(text|quantity|list)+",
    "quantity": "name? description? (noQuantity|real) usedMethods? measurementMetaData?",
    "measurementMetaData": "metaData+",
    "real": "label? quantityTypeQUDT? value unit measurementUncertaintyUnivariate?",
    "measurementUncertaintyUnivariate": "standardMU|expandedMU|coverageIntervalMU",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability distribution?",
    "usedSoftware": "software+",
    **dict.fromkeys(("description", "declaration", "noQuantity", "further", "text"), RICH),
}
NUMBER = r"[-+]?(\d*\.\d+|\d+\.?)([Ee][-+]?\d+)?"
LINE = r"\S+(\s+\S+)*"
VALUES: Mapping[str, str] = {
    "countryCodeISO3166_1": "[A-Z]{2}",
    "usedLangCodeISO639_1": "[a-z]{2}",
    "mandatoryLangCodeISO639_1": "[a-z]{2}",
    "beginPerformanceDate": r"\d{4}-\d\d-\d\d",
    "endPerformanceDate": r"\d{4}-\d\d-\d\d",
    "issueDate": r"\d{4}-\d\d-\d\d",
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "mainSigner": "true|false",
    "conformity": "pass|fail|conditionalPass|conditionalFail|noPass|noFail",
    "valueExpandedMU": NUMBER.replace("[-+]?", "", 1),
    "coverageFactor": r"[1-9]\d*(\.\d*)?",
    "coverageProbability": r"0(\.\d*)?|1(\.0*)?",
    "unit": r"(\\[a-z]+(\{-?\d+\})?)+",
}


def faults(root: Any) -> Iterator[str]:
    """Yield where elements differ from what the schema says of them."""
    for element in root.iter():
        space, name = re.fullmatch(r"\{(.*)\}(\w+)", element.tag).groups()
        children = [child.tag.split("}")[1] for child in element]
        if space == DCC and name == "name":
            allowed = WORDS
        elif name in CONTENT:
            allowed = CONTENT[name]
        else:
            allowed = TEXT
        if allowed == TEXT:
            value = NUMBER if (space, name) == (SI, "value") else VALUES.get(name, LINE)
            if children or not re.fullmatch(value, element.text or ""):
                yield f"{name}: {element.text!r} {children}"
        else:
            pattern = re.sub(r"\w+", lambda found: f"(?:{found[0]} )", allowed).replace(" (", "(")
            if not re.fullmatch(pattern.replace("  ", " "), "".join(f"{child} " for child in children)):
                yield f"{name}: {children}; expected {allowed}"


@pytest.mark.parametrize("which", ["of_model", "of_part"])
def test_the_digital_certificate_has_the_structure_of_the_schema(which: str, request: pytest.FixtureRequest) -> None:
    """Elements, their order and their values are as published; without any identity, too."""
    certificate = request.getfixturevalue(which)
    for one in (certificate, replace(certificate, identity=Identity(), budget=None, ranges=())):
        root = etree.fromstring(digital_certificate(one))
        assert list(faults(root)) == []
        assert root.get("schemaVersion") == DCC_VERSION


def test_the_structure_finds_a_fault(of_model: Certificate) -> None:
    """The oracle itself: a mandatory element that is missing, and a number that is none, are found."""
    root = etree.fromstring(digital_certificate(of_model))
    root.find(f".//{{{DCC}}}coreData").remove(root.find(f".//{{{DCC}}}uniqueIdentifier"))
    root.find(f".//{{{SI}}}value").text = "inf"

    assert len(list(faults(root))) == 2


@pytest.mark.parametrize("which", ["of_model", "of_part"])
def test_the_digital_certificate_is_valid(which: str, request: pytest.FixtureRequest) -> None:
    """By the schema of PTB itself, where dcc-json-toolkit has cached it: python -m dcc_json_toolkit, once and online."""
    toolkit = pytest.importorskip("dcc_json_toolkit.cache", reason="no dcc-json-toolkit here, which caches the schema")
    path = toolkit.CACHE_DIR_PATH / DCC_VERSION / "dcc.xsd"
    if not path.is_file():
        pytest.skip(f"the schema {DCC_VERSION} of PTB is not cached here")
    schema = etree.XMLSchema(etree.parse(path))

    schema.assertValid(etree.fromstring(digital_certificate(request.getfixturevalue(which))))


@pytest.mark.long
@pytest.mark.parametrize("which", ["of_model", "of_part"])
def test_the_digital_certificate_keeps_the_rules_of_ptb(which: str, request: pytest.FixtureRequest) -> None:
    """By the Schematron rules that PTB keeps beside its schema: methods, conditions, releases, languages, units."""
    rules = pytest.importorskip("dcclib.validation.schematron", reason="no dcclib here, which has the rules of PTB")
    # A country that was not stated is none by these rules.
    certificate = replace(request.getfixturevalue(which), identity=Identity(country="DE"))

    found = rules.SchematronValidator.for_dcc().validate_str(digital_certificate(certificate).decode())

    assert found.is_valid, found.failed_assertions


def test_units_beyond_the_digital_system_stand_as_text() -> None:
    """Pixels are results, too; the readings of an IMU have units of it."""
    figures = [Figure(name="mean", value=0.25, unit=unit) for unit in ("px", "m/s^2", "mrad/s")]
    group = FigureGroup(title="errors", figures=tuple(figures))
    bare = {"title": "t", "issue": ISSUE, "item": "i", "identity": Identity(), "files": {"a": "b"}, "versions": {}}

    certificate = Certificate(groups=(group,), **bare)
    xml = digital_certificate(certificate)

    assert "m/s²" in certificate_page(certificate) and "m/s^2" not in certificate_page(certificate)
    assert list(faults(etree.fromstring(xml))) == []
    assert b">0.25 px<" in xml and rb">\metre\second\tothe{-2}<" in xml


def test_what_is_not_stated_is_marked(of_model: Certificate) -> None:
    """Instrument and certificate may be missing, but not unnoticed; traceability is no more than was stated."""
    bare = replace(of_model, identity=Identity())
    page = certificate_page(bare)

    assert "instrument: not stated; its calibration certificate: not stated" in page
    assert set(bare.lacking) >= {"robot", "instrument", "certificate", "date"}
    assert of_model.lacking == ()
    assert "tracker 7512" in certificate_page(of_model)


def test_source_of_lengths_sockets_are_of_no_instrument(known: FittedRobot, of_model: Certificate) -> None:
    """The sheet names the distance of its sockets, or that none was given; of measured sockets it names an instrument."""

    def lengths(**setup: Any) -> str:
        return source_of_lengths(known.with_station(replace(known.station, sensor_kind="socket", setup=Setup(**setup))))

    unknown = {"a": None, "b": None}
    given = lengths(points=unknown, distances=(KnownDistance("a", "b", 0.05), KnownDistance("x", "y", 0.3)))
    words = replace(of_model, lengths=given).traceability

    assert given == "the distances between sockets as given: a to b 50.000 ± 0.020 mm (95 %)"
    assert (
        words.startswith("No instrument measured the robot's lengths: they are those of the distances")
        and "7512" not in words
    )
    assert "an error of these lengths" in words and "instrument's" not in words
    assert "an error of the instrument's scale" in of_model.traceability
    assert lengths(points=unknown) == "its description: no distance between sockets was given"
    assert lengths(points={"a": (0.0, 0.0, 0.0), "b": None}) == source_of_lengths(known) == ""


def test_lengths_that_no_reading_told_are_those_of_the_description(known: FittedRobot) -> None:
    """As of an IMU alone; one length that was fitted is enough to say nothing of it, as is a place that was read."""
    estimate = known.estimate
    is_length = np.array([p.unit == "m" and p.effect == "link_geometry" for p in estimate.parameters])
    held = known.with_model(known.model, of_free(estimate, ~is_length))
    one = is_length & (np.cumsum(is_length) > 1)

    assert held.holds_lengths and not known.holds_lengths
    assert not known.with_model(known.model, of_free(estimate, ~one)).holds_lengths
    assert source_of_lengths(held) == ""


def test_a_model_whose_effects_need_more_of_a_pose_has_no_budget(tmp_path: Path, kuka: Robot) -> None:
    """The sheet says why; the figures of the calibration stand, and the XML keeps its structure."""
    settling = ALL_EFFECTS["settling"](kuka.joint_names)
    found = drawn(settling, kuka)
    found.save(tmp_path / "model.json")
    result = RESULT | {"parameters": parameters_of(found)}
    (tmp_path / "result.json").write_text(json.dumps(result))

    certificate = certificate_of_model(tmp_path / "model.json", Identity(), ISSUE)

    assert certificate.budget is None and certificate.facts["budget"].startswith("none: settling needs the column time")
    assert certificate.groups[-1].figures[0].value == RESULT["uncertainty"]["here_mm"]
    assert list(faults(etree.fromstring(digital_certificate(certificate)))) == []


def test_a_model_without_its_result_is_refused(tmp_path: Path, known: FittedRobot) -> None:
    """There are no figures to state; the error says where they would be."""
    known.save(tmp_path / "model.json")

    with pytest.raises(BadInputError, match=r"result\.json: not there.*folder that calibrate or discover wrote"):
        certificate_of_model(tmp_path / "model.json", Identity(), ISSUE)


def test_the_result_of_another_model_is_refused(tmp_path: Path, known: FittedRobot) -> None:
    """A model that was saved beside the result of another has no figures of its own."""
    known.save(tmp_path / "model.json")
    others = parameters_of(known)[:-1]
    (tmp_path / "result.json").write_text(json.dumps(RESULT | {"parameters": others}))

    with pytest.raises(BadInputError, match="not those of the model beside it"):
        certificate_of_model(tmp_path / "model.json", Identity(), ISSUE)


def test_the_verdict_of_a_search_counts(tmp_path: Path, known: FittedRobot) -> None:
    """What a search says the model lacks stands on the sheet, though the residuals of the fit are noise."""
    known.save(tmp_path / "model.json")
    result = RESULT | {"parameters": parameters_of(known), "verdict": "adequate", "warnings": []}
    (tmp_path / "result.json").write_text(json.dumps(result))
    gap = {"mean_mm": 0.1, "rms_mm": 0.1, "max_mm": 0.2}
    found = {"noise_floor_mm": 0.05, "gap": {"before": gap, "after": gap}, "where": [], "scatter": []}
    found |= {"not_testable": [], "unexplained_mm": 0.0312, "verdict": "not adequate"}
    effect = {"effect": "backlash", "joint": "joint_2", "parameters": {}, "p_value": 0.0, "equivalent": []}
    effect |= {"gap_before_mm": 0.2, "gap_after_mm": 0.1, "tell_apart": ""}
    doubt = [{"severity": "doubt", "text": "joint 3 scatters"}]
    (tmp_path / "discovery.json").write_text(json.dumps(found | {"effects": [effect], "warnings": doubt}))

    certificate = certificate_of_model(tmp_path / "model.json", Identity(), ISSUE)

    assert (certificate.verdict, certificate.doubts) == ("not adequate", ("joint 3 scatters",))
    assert certificate.facts["search"] == "backlash of joint_2 found; 0.0312 mm unexplained"
    (tmp_path / "discovery.json").write_text(json.dumps(found | {"effects": [effect], "unexplained_mm": 4e-4}))
    certificate = certificate_of_model(tmp_path / "model.json", Identity(), ISSUE)
    assert certificate.facts["search"] == "backlash of joint_2 found; the rest is noise"


def test_text_from_files_is_safe(of_model: Certificate) -> None:
    """Marks of XML and HTML, and characters that XML has not, stay text."""
    hostile = "<b>&\x01]]>"
    certificate = replace(of_model, item=hostile, doubts=(hostile,), facts={hostile: hostile})

    root = etree.fromstring(digital_certificate(certificate))

    assert list(faults(root)) == []
    assert root.findtext(f".//{{{DCC}}}item/{{{DCC}}}name/{{{DCC}}}content") == r"<b>&\x01]]>"
    assert "<b>&" not in certificate_page(certificate)


def test_the_model_of_another_robot_is_refused(folder: Path) -> None:
    """No certificate of one robot is made of the calibration of another."""
    with pytest.raises(BadInputError, match=r"is of robot 2021-17.*2021-18"):
        certificate_of_model(folder / "model.json", Identity(robot="2021-18"), ISSUE)


def test_no_figure_is_infinite() -> None:
    """A number that is none would be valid nowhere."""
    with pytest.raises(BadInputError, match="finite"):
        Figure(name="mean", value=float("nan"), unit="mm")


def test_the_command_writes_both_files_beside_the_results(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder of the results may be that of the certificate, and keeps its files; doubts are printed."""
    before = {file.name for file in folder.iterdir()}

    assert run("certificate", folder, "--out", folder, "--number", "C-18", "--issued", "2026-11-30") == 0

    assert {file.name for file in folder.iterdir()} == before | {"certificate.html", "dcc.xml"}
    printed = capsys.readouterr()
    assert f"doubt: {DOUBT}" in printed.out and "No. C-18" in printed.out
    assert b"<dcc:issueDate>2026-11-30<" in (folder / "dcc.xml").read_bytes()


def test_the_cell_says_who_certifies_and_not_what_was_measured(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the model states stays, and what it does not state of robot and readings is not stated."""
    for name in ("model.json", "result.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PINCAL_CELL")
    known = load_model("model.json").identity
    stated = {
        "laboratory": "Lab of the cell",
        "country": "FR",
        "customer": "Cust",
        "place": "Elsewhere",
        "operator": "E. Lse",
    }
    Path("cell.toml").write_text("[id]\n" + "\n".join(f'{key} = "{value}"' for key, value in stated.items()))
    capsys.readouterr()
    assert run("certificate", "model.json") == 0
    assert "cell.toml: id (laboratory, country, customer)\n" in capsys.readouterr().err
    page = Path("certificate.html").read_text()
    assert (known.laboratory or stated["laboratory"]) in page and (known.customer or "Cust") in page
    assert "E. L." not in page and "Elsewhere" not in page
    assert run("certificate", "model.json", "--set", "id.laboratory=Lab of mine", "--set", "id.place=Hall 9") == 0
    page = Path("certificate.html").read_text()
    assert "Lab of mine" in page and "Lab of the cell" not in page and "Hall 9" in page


def test_a_certificate_does_not_outlive_its_calibration(tmp_path: Path) -> None:
    """A run into the same folder removes it: it would seem to be of the new model."""
    folder = tmp_path / "results"
    folder.mkdir()
    for name in ("model.json", "certificate.html", "dcc.xml", "notes.txt"):
        (folder / name).write_text("{\n}\n")

    with output_folder(folder) as draft:
        (draft / "model.json").write_text("{\n}\n")

    assert {file.name for file in folder.iterdir()} == {"model.json", "notes.txt"}


def test_the_file_of_a_measured_part_is_certified_as_its_folder(tmp_path: Path) -> None:
    """measured.json by its own name says the same as the folder that holds it."""
    (tmp_path / "measured.json").write_text(json.dumps(MEASURED))

    assert run("certificate", tmp_path / "measured.json", "--out", tmp_path / "a", "--issued", "2026-11-30") == 0
    assert run("certificate", tmp_path, "--out", tmp_path / "b", "--issued", "2026-11-30") == 0

    assert (tmp_path / "a" / "dcc.xml").read_bytes() == (tmp_path / "b" / "dcc.xml").read_bytes()


def test_a_decision_that_is_none_is_refused_with_its_place(tmp_path: Path) -> None:
    """The quantity stands in a dictionary, whose key the decoder does not tell."""
    changed = json.loads(json.dumps(MEASURED))
    next(iter(changed["features"][0]["values"].values()))["decision"] = "perhaps"
    (tmp_path / "measured.json").write_text(json.dumps(changed))

    with pytest.raises(BadInputError, match=r"decision: is 'perhaps'; expected one of .*conforms"):
        certificate_of_measured(tmp_path, Identity(), ISSUE)


def test_a_provenance_of_ones_own_is_no_checksum(tmp_path: Path) -> None:
    """Text is; a number among the inputs is left out, and the certificate is written."""
    own = MEASURED | {"provenance": {"inputs": {"part.toml": "ab12", "run": 3}}}
    (tmp_path / "measured.json").write_text(json.dumps(own))

    found = certificate_of_measured(tmp_path, Identity(), ISSUE)

    assert found.files["part.toml"] == "ab12" and "run" not in found.files
    assert "ab12" in certificate_page(found)


@pytest.mark.parametrize(
    "words",
    [
        ["--issued", "30.11.2026"],
        ["--issued", "20261130"],
        ["--issued", "2026-W48-1"],
        ["--set", "id.robt=1"],
        ["--number", "C-17\nC-18"],
        ["--number", "9" * 201],
    ],
)
def test_wrong_words_are_wrong_usage(words: list[str], folder: Path) -> None:
    """A day that is none or written otherwise, an entry that is none, and a number that is no line of text."""
    assert run("certificate", folder, "--out", folder, *words) == 2


def test_a_folder_without_results_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The error says what is expected."""
    assert run("certificate", tmp_path, "--out", tmp_path / "out") == 3
    assert "expected a model.json, or the folder that pincal measure wrote" in capsys.readouterr().err


@pytest.mark.long
def test_the_sheet_of_a_robot_prints_on_one_page(of_model: Certificate, tmp_path: Path, browser: Any) -> None:
    """With all entries stated and four doubts of three lines; on a phone nothing is cut off."""
    doubts = tuple(f"{DOUBT}: {'the model is incomplete, or what was declared is too small; ' * 3}" for _ in range(4))
    path = tmp_path / "certificate.html"
    path.write_text(certificate_page(replace(of_model, doubts=doubts)))
    browser.get(path.as_uri())

    printed = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})

    pdf = base64.b64decode(printed["data"])
    assert len(re.findall(rb"/Type\s*/Page[^s]", pdf)) == 1
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    )
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert not browser.get_log("browser")
