"""The report in a real browser: silent on the console, readable on phone and desk, light and dark, names stay text."""

import base64
import time
from pathlib import Path
from typing import Any

import pytest
from report_cases import HOSTILE, ORIGIN, discovered, discovered_many, drifted, hostile_run, kuka_run

from pincal import Robot
from pincal.diagnosis.diagnosis_page import diagnosis_page
from pincal.discover.report.search_answer import SearchAnswer
from pincal.report.html import report_page
from pincal.report.subject import Subject

pytestmark = pytest.mark.drawn
ROOMS = pytest.mark.rooms("pincal/report", "pincal/discover/report", "tests/report_cases.py")
SIZES = {"desk": (1280, 800), "phone": (390, 844)}
# Text with its colour and that of the ground it stands on; contrast as in WCAG 2.
CONTRAST = """
const linear = v => { v /= 255; return v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4; };
const light = c => { const [r, g, b] = c.map(linear);
  return .2126 * r + .7152 * g + .0722 * b; };
const rgb = s => (s.match(/[\\d.]+/g) || []).map(Number);
const ground = e => { for (; e; e = e.parentElement) { const c = rgb(getComputedStyle(e).backgroundColor);
  if (c.length === 3 || c[3] > 0) return c.slice(0, 3); } return [255, 255, 255]; };
const found = [];
for (const e of document.querySelectorAll('p, li, td, th, dd, dt, h1, h2, h3, a, figcaption, code, .tag, svg text')) {
  const style = getComputedStyle(e), drawn = e.closest('svg');
  if (!e.textContent.trim()) continue;
  const a = light(rgb(drawn ? style.fill : style.color).slice(0, 3)), b = light(ground(drawn || e));
  const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
  if (ratio < 4.5) found.push([ratio, e.textContent.slice(0, 40)]);
}
return found;
"""
# Labels that stick out of their figure, and labels too small to read [px].
LABELS = """
const cut = [], small = [];
for (const svg of document.querySelectorAll('figure svg')) {
  const box = svg.getBoundingClientRect();
  for (const text of svg.querySelectorAll('text')) {
    const b = text.getBoundingClientRect();
    if (b.left < box.left - 2 || b.right > box.right + 2 || b.top < box.top - 2 || b.bottom > box.bottom + 2)
      cut.push(text.textContent);
    const across = Math.min(b.width, b.height);
    if (text.textContent.trim().length > 2 && across < 9) small.push([text.textContent, across]);
  }
}
return [cut, small];
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, kuka: Robot) -> dict[str, Path]:
    """Write a report without held-out rows, one with hostile names, and discoveries of one effect and of fourteen."""
    folder = tmp_path_factory.mktemp("reports")
    found, many = discovered(), discovered_many(14)
    subjects = {
        "plain": Subject(kuka_run(kuka, test_fraction=0.0), ORIGIN, ("a note",)),
        "hostile": Subject(hostile_run(), ORIGIN, ("a note",)),
        "found": Subject(found.calibration, ORIGIN, (), SearchAnswer(found)),
        "many": Subject(many.calibration, ORIGIN, (), SearchAnswer(many)),
    }
    for name, subject in subjects.items():
        (folder / f"{name}.html").write_text(report_page(subject), encoding="utf-8")
    return {name: folder / f"{name}.html" for name in subjects}


def show(browser: Any, page: Path, size: str = "desk", scheme: str = "light") -> None:
    """Open a page in a window of a size, in light or dark."""
    width, height = SIZES[size]
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == "phone"}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]})
    browser.get(page.as_uri())


@pytest.fixture(autouse=True)
def as_it_was(browser: Any) -> Any:
    """Take the emulation away after each test: others use the same window."""
    browser.get_log("browser")
    yield
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@pytest.mark.long
@pytest.mark.parametrize("name", ["plain", "hostile", "found"])
def test_it_loads_in_silence_and_by_itself(browser: Any, pages: dict[str, Path], name: str) -> None:
    """Nothing on the console, nothing asked of the network, every image decoded."""
    show(browser, pages[name])
    assert browser.get_log("browser") == []
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in fetched if not name.startswith("data:")] == []
    decoded = browser.execute_async_script(
        "const done = arguments[0], all = [...document.images, ...document.querySelectorAll('image')];"
        "Promise.all(all.map(i => i.decode())).then(() => done(true), () => done(false))"
    )
    assert decoded is True


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("name", ["plain", "hostile", "found", "many"])
@pytest.mark.parametrize("size", SIZES)
def test_it_fits_and_can_be_read(browser: Any, pages: dict[str, Path], name: str, size: str) -> None:
    """The page does not scroll sideways, folded or not; labels of figures are whole and of a readable size."""
    show(browser, pages[name], size)
    for script in ("", "document.querySelectorAll('details').forEach(part => part.open = true);"):
        wide, room = browser.execute_script(f"{script} return [document.documentElement.scrollWidth, window.innerWidth]")
        assert wide <= SIZES[size][0] == room
    cut, small = browser.execute_script(LABELS)
    assert cut == [] and small == []


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("name", ["plain", "hostile", "found"])
@pytest.mark.parametrize("size", SIZES)
def test_no_table_is_wider_than_the_page(browser: Any, pages: dict[str, Path], name: str, size: str) -> None:
    """Rows of wide ones are lines on a phone, every cell but empty ones behind its heading."""
    show(browser, pages[name], size)
    browser.execute_script("document.querySelectorAll('details').forEach(part => part.open = true);")
    wider = "return [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth + 1)"
    assert [table.text[:60] for table in browser.execute_script(wider)] == []
    hidden = (
        "return [...document.querySelectorAll('.many td')].filter(e => !e.checkVisibility() && /[^- ]/.test(e.innerText))"
    )
    assert browser.execute_script(hidden) == []


@pytest.mark.long
def test_a_diagnosis_fits_a_phone(browser: Any, kuka: Robot, tmp_path: Path) -> None:
    """Under four screens, and not wider than one."""
    (tmp_path / "report.html").write_text(diagnosis_page(drifted(kuka), version="0"), encoding="utf-8")
    show(browser, tmp_path / "report.html", "phone")
    size = browser.execute_script("const all = document.documentElement; return [all.scrollWidth, all.scrollHeight]")
    assert size[0] <= SIZES["phone"][0] and size[1] < 4 * SIZES["phone"][1]


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("name", ["plain", "hostile", "found", "many"])
def test_it_is_short_on_a_phone(browser: Any, pages: dict[str, Path], name: str) -> None:
    """Under ten screens, however many effects were found."""
    show(browser, pages[name], "phone")
    length = browser.execute_script("return document.documentElement.scrollHeight")
    assert length < 10 * SIZES["phone"][1]


@pytest.mark.long
@ROOMS
@pytest.mark.parametrize("name", ["plain", "found"])
def test_light_and_dark_differ_and_both_have_contrast(browser: Any, pages: dict[str, Path], name: str) -> None:
    """Every text, those in figures too, has a contrast of 4.5 to 1 at least in both schemes."""
    seen = []
    for scheme in ("light", "dark"):
        show(browser, pages[name], "desk", scheme)
        assert browser.execute_script(CONTRAST) == []
        seen.append(base64.b64decode(browser.get_screenshot_as_base64()))
    assert seen[0] != seen[1]


@pytest.mark.long
def test_hostile_names_appear_as_text(browser: Any, pages: dict[str, Path]) -> None:
    """No script of a name has run, no element was made of one, and it is there to be read."""
    show(browser, pages["hostile"])
    time.sleep(0.1)
    hacked, scripts, bold = browser.execute_script(
        "return [window.hacked === undefined, document.scripts.length, document.querySelectorAll('[onload]').length]"
    )
    assert hacked and scripts == 0 and bold == 0
    text = browser.execute_script("return document.body.innerText")
    assert HOSTILE.split("\n")[0] in text and "{{ 7 * 7 }}" in text


@pytest.mark.long
@ROOMS
def test_it_prints_in_light(browser: Any, pages: dict[str, Path]) -> None:
    """On paper the page is light even for a reader who prefers dark, and no wider than the sheet; nothing is folded."""
    show(browser, pages["found"], "desk", "dark")
    media = {"media": "print", "features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    ground = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    folded = browser.execute_script(
        "return [...document.querySelectorAll('details > :not(summary)')].map(e => e.offsetHeight)"
    )
    assert folded and all(folded)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert ground == "rgb(255, 255, 255)"
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True, "paperWidth": 8.27, "paperHeight": 11.69})
    assert len(base64.b64decode(printed["data"])) > 50_000
