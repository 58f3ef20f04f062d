"""The page of a calibration: what it says, that names stay text, and that odd cases still make a page."""

import html
import re
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from msgspec import UNSET
from report_cases import HOSTILE, ORIGIN, discovered, hostile_run, kuka_run, page_of, panda_run

from pincal import Robot
from pincal.calibration.calibration import Calibration
from pincal.discover.report.search_answer import SearchAnswer
from pincal.discover.run import Discovery
from pincal.identify.explain import Cause, Reason
from pincal.report import parameter_sections, sections
from pincal.report.blocks import Section, paragraph
from pincal.report.html import SECTIONS, report_page
from pincal.report.judgement import judged, narrow_joints, next_steps, unidentified_groups
from pincal.report.result_section import _headline
from pincal.report.subject import Subject
from pincal.report.words import effect_meaning, is_worse_elsewhere
from pincal.result_table import Column, Kind, Table
from pincal.units import fixed
from pincal.validate.outcome import Elsewhere

pytestmark = pytest.mark.drawn


class Page(HTMLParser):
    """Elements, identifiers and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.identifiers: list[str] = []
        self.references: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Note an element, its identifier and what it refers to."""
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.identifiers.append(value)
            if name in ("src", "href") or "url(" in (value or ""):
                self.references.append(value)
            assert not name.startswith("on"), f"{tag} has {name}"

    def handle_data(self, data):
        """Collect text."""
        self.text += data


@pytest.fixture(scope="module")
def run(kuka: Robot) -> Calibration:
    return kuka_run(kuka)


@pytest.fixture(scope="module")
def page(run: Calibration) -> str:
    return page_of(run)


@pytest.fixture(scope="module")
def found() -> Discovery:
    return discovered()


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures away, where only words are looked at."""
    monkeypatch.setattr("pincal.report.illustrations.inline_svg", lambda *_, **__: "")


def test_the_page_may_load_nothing(page: str) -> None:
    """Before anything else the browser is told: no script, nothing from the network, no form."""
    head = page.partition("<title>")[0]
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', head, re.IGNORECASE)
    assert policy is not None
    rules = dict(rule.split(maxsplit=1) for rule in policy[1].split("; "))
    assert rules.pop("default-src") == rules.pop("base-uri") == rules.pop("form-action") == "'none'"
    assert rules == {"style-src": "'unsafe-inline'", "img-src": "data:"}


def test_the_page_needs_nothing_from_elsewhere(page: str) -> None:
    """No script, no reference out of the page, no identifier twice."""
    parsed = Page(page)
    assert "script" not in parsed.tags and "link" not in parsed.tags and "http" not in page
    assert all(ref.startswith(("#", "data:image/png;base64,")) or "url(#" in ref for ref in parsed.references)
    assert len(parsed.identifiers) == len(set(parsed.identifiers))
    own = set(parsed.identifiers)
    assert {ref[1:] for ref in parsed.references if ref.startswith("#")} <= own


def test_rows_that_are_cross_validated_are_counted_once(kuka: Robot, no_figures: None) -> None:
    """The head of the page has the number of poses, and no other number of rows where each pose has one."""
    crossed = kuka_run(kuka, 60, test_fraction=0.0)

    assert "6 joints, 60 measured poses\n" in Page(page_of(crossed).replace("</p>", "\n</p>")).text


def test_the_nutshell_has_the_held_out_numbers(page: str, run: Calibration) -> None:
    """Mean before and after on held-out poses, the noise, and what to do next stand at the top."""
    top = Page(page[: page.index('id="subject"')]).text
    errors = {model: run.result.error[model]["test"]["mean_mm"] for model in ("nominal", "calibrated")}
    assert f"{errors['nominal']:.3f}" in top and f"{errors['calibrated']:.4f}" in top
    assert "that the calibration has not used" in top
    assert "What to do next" in top and "adequate" in top and "0.0500 mm" in top


def test_all_that_a_report_owes_is_there(page: str, run: Calibration) -> None:
    """Every parameter with its reason, every joint with its figure, correlations, what it rests on."""
    parsed = Page(page)
    for row in run.result.parameters:
        assert row.name in parsed.text and html.unescape(str(row.reason)) in parsed.text
    figures = re.findall(r"<figure>.*?</figure>", page, flags=re.DOTALL)
    assert len(figures) >= 3 + run.robot.n_joints + 4
    assert all('role="img" aria-label="' in figure for figure in figures)
    for words in ("Strong correlations", "what to measure", "SHA-256", "pincal test", "repeatability", "compliance"):
        assert words in parsed.text


def test_colours_of_figures_are_the_pages(page: str) -> None:
    """Ink, grid and the colours of before and after follow light and dark."""
    assert all(f"var(--{name})" in page for name in ("ink", "muted", "grid", "before", "after"))
    assert "#1b1f24" not in page[page.index("</style>") :] and "prefers-color-scheme: dark" in page


@pytest.mark.long
def test_a_hostile_name_is_text() -> None:
    """Names of robot, link, joint and table that would be mark-up stay text, in figures, too."""
    run = hostile_run()
    page = page_of(run)
    parsed = Page(page)
    assert "script" not in parsed.tags and "b onload" not in page.replace("&lt;b onload", "")
    assert HOSTILE.split("\n")[0] in parsed.text and "{{ 7 * 7 }}" in parsed.text
    assert run.robot.joint_names[1] == HOSTILE + "2"


def test_no_held_out_rows_are_said_to_be_none(kuka: Robot, no_figures: None) -> None:
    """Without held-out rows the page says that its numbers are those of the fit."""
    whole = kuka_run(kuka)
    errors = {model: {"train": parts["train"]} for model, parts in whole.result.error.items()}
    bare = replace(whole.result, error=errors, rows={"train": 120, "test": 0}, validation=UNSET)
    text = Page(page_of(replace(whole, result=bare, validated=None))).text
    assert "No poses were held out" in text and "No rows were held out" in text and "--holdout" in text


@pytest.mark.long
def test_seven_joints_make_a_page() -> None:
    """A 7R arm has a figure for each of its joints."""
    page = page_of(panda_run())
    assert all(f"Error against the position of panda_joint{i}" in page for i in range(1, 8))


@pytest.mark.long
@pytest.mark.parametrize(("kind", "words"), [("pose", "orientation error"), ("distance", "distance error")])
def test_other_readings_make_a_page(kuka: Robot, kind: str, words: str) -> None:
    """Errors of orientation have figures of their own, distances are no positions."""
    page = page_of(kuka_run(kuka, 140, kind=kind))
    assert words in page
    assert ("mrad</span>" in page) == (kind == "pose")


def test_the_view_is_linked_if_there_is_one(run: Calibration, page: str, no_figures: None) -> None:
    """A file beside the report is linked; without one the page says how to make it."""
    assert 'href="view 3d.html"'.replace(" ", "%20") in page_of(run, view="view 3d.html")
    assert "pincal view model.json" in page and "view3d.html</a>" not in page


def test_many_joints_and_parameters_are_folded(
    run: Calibration, page: str, no_figures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two robots have twelve joints and more, whose figures would be five screens of a phone."""
    assert "further joint" not in page
    assert "parameters determined</summary>" not in page
    monkeypatch.setattr(sections, "_DRAWN_JOINTS", 4)
    monkeypatch.setattr(parameter_sections, "_LISTED_PARAMETERS", 3)
    page = page_of(run)

    assert "<summary>2 further joints</summary>" in page
    assert re.search(r"<summary>\d+ parameters determined</summary>", page)


def test_a_section_is_a_function(run: Calibration, no_figures: None) -> None:
    """A section of the user's own is one function in the layout: it has its place, its link and its table, escaped."""

    def ranges(subject: Subject) -> Section:
        table = Table("Ranges", (Column("<joint>"), Column("range", "rad", Kind.NUMBER, fixed(2))), (("a<b", 1.5),))
        return Section("ranges", "Ranges of joints", (paragraph("How far & wide."), table), "Ranges")

    page = report_page(Subject(run, ORIGIN), layout=(SECTIONS[0], ranges))
    assert '<a href="#ranges">Ranges</a>' in page and '<h2 id="ranges">Ranges of joints</h2>' in page
    assert "How far &amp; wide." in page and "a&lt;b" in page and "1.50" in page and 'id="parameters"' not in page
    assert page.index('id="summary"') < page.index('id="ranges"')


@pytest.mark.long
def test_a_discovery_is_told_step_by_step(found: Discovery) -> None:
    """Where, which, how sure, what else, and a figure of the gap and of each effect."""
    page = report_page(Subject(found.calibration, ORIGIN, search=SearchAnswer(found)))
    text = " ".join(Page(page).text.split())
    for entry in found.report["where"]:
        assert entry["statement"] in text
    for entry in found.report["effects"]:
        assert entry["effect"] in text and effect_meaning(entry["effect"]) in text
    assert page.count("without and with it") == len(found.traces) and "Error on held-out rows after each step" in page
    assert "noise alone" in text and "p-value" in text


def test_verdicts(run: Calibration) -> None:
    """Declared noise is a measure, estimated noise none; a fit that did not settle is not to be used."""
    result = run.result
    assert judged(result).judgement == "adequate"
    assert judged(replace(result, chi2_p_value=None)).judgement == "not judged"
    assert judged(replace(result, chi2_p_value=1e-9)).judgement == "not adequate"
    assert judged(replace(result, converged=False)).judgement == "not adequate"


def test_next_steps_follow_from_what_is_wrong(run: Calibration) -> None:
    """What misses something is to be searched; outliers are to be looked at."""
    worse = replace(run, result=replace(run.result, chi2_p_value=1e-9, outliers=(3, 4)))
    steps = " ".join(map(str, next_steps(worse)))
    assert "pincal discover" in steps and "line 3, 4" in steps
    assert "Use it" in " ".join(map(str, next_steps(run)))


@pytest.mark.parametrize(("ratio", "is_advised"), [(1.28, False), (1.32, True)])
def test_more_poses_are_advised_where_held_out_errors_are_larger(run: Calibration, ratio: float, is_advised: bool) -> None:
    """By 1.3 and more: a quarter of the readings has gone into parameters."""
    parts = dict(run.result.error["calibrated"])
    rms = parts["train"]["rms_mm"]
    parts |= {way: {**errors, "rms_mm": ratio * rms} for way, errors in parts.items() if way != "train"}
    error = {**run.result.error, "calibrated": parts, "nominal": {"test": {**parts["test"], "rms_mm": 99.0}}}
    steps = " ".join(map(str, next_steps(replace(run, result=replace(run.result, error=error)))))

    assert ("Held-out errors exceed fitted ones" in steps) == is_advised


def test_more_poses_are_advised_where_the_model_expects_larger_errors() -> None:
    """Half as large again as at poses like the measured ones."""
    for mean, is_worse in ((1.49, False), (1.51, True)):
        assert is_worse_elsewhere(Elsewhere(mean, 2.0, "", 10, ""), {"mean_mm": 1.0}) == is_worse


@pytest.mark.parametrize(("ratio", "times"), [(1.04, ""), (1.06, "(1.1 times as large)")])
def test_a_ratio_that_rounds_to_one_is_left_out(run: Calibration, ratio: float, times: str) -> None:
    """An error before the calibration that is as large as after it is not said to be 1.0 times as large."""
    part = "test" if "test" in run.result.error["calibrated"] else "train"
    after = run.result.error["calibrated"][part]
    nominal = {**run.result.error["nominal"], part: {**after, "mean_mm": ratio * after["mean_mm"]}}
    subject = Subject(
        replace(run, result=replace(run.result, error={**run.result.error, "nominal": nominal})), {"inputs": {}}
    )
    words = Page(_headline(subject)).text

    assert ("times as large" in words) == bool(times) and times in words


def test_causes_cover_every_reason(run: Calibration) -> None:
    """Each parameter that is not identified has a cause with advice, and so has every cause that there is."""
    groups = unidentified_groups(run.result.parameters)
    assert sum(len(group.names) for group in groups) == sum(row.status != "identified" for row in run.result.parameters)
    row = next(row for row in run.result.parameters if row.status != "identified")
    for cause in Cause:
        if cause is not Cause.NONE:
            assert unidentified_groups([replace(row, reason=Reason(cause))])[0].advice.text


def test_a_joint_that_hardly_moved_is_named(run: Calibration) -> None:
    """A joint that covers little of its range is named with the part that it does."""
    q = run.train.q.copy()
    q[:, 2] *= 0.05
    q[:, 3] *= 0.32 * (run.robot.upper[3] - run.robot.lower[3]) / np.ptp(q[:, 3])
    moved = (replace(run.station, train=replace_q(run.train, q)),)
    assert [name for name, _ in narrow_joints(replace(run, stations=moved))] == ["joint_3"]
    assert narrow_joints(run) == ()


def replace_q(table, q):
    from pincal.measure.table import measurements_from_arrays

    return measurements_from_arrays(table.joint_names, q, position=table.position)


@pytest.mark.long
def test_twelve_thousand_rows_take_seconds_and_few_megabytes(kuka: Robot, tmp_path: Path) -> None:
    """The report of 12000 rows is written within 5 s and is no larger than 5 MB."""
    run = kuka_run(kuka, 12000)
    begun = time.process_time()
    (tmp_path / "report.html").write_text(report_page(Subject(run, ORIGIN)), encoding="utf-8")
    seconds, size = time.process_time() - begun, (tmp_path / "report.html").stat().st_size / 1e6
    print(f"report of {len(run.train) + len(run.test)} rows: {seconds:.2f} s, {size:.2f} MB")
    assert size <= 5.0 and seconds <= 5.0
