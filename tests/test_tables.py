"""Tables of results: one set of data, the same content on a terminal, on a page, in CSV and in data frames."""

import csv
import io
from html.parser import HTMLParser

import polars as pl
import pytest
from rich.console import Console

from pincal.calibration.result_tables import ParameterRow, correlation_table, error_table, iso9283_table, parameter_table
from pincal.identify.explain import IDENTIFIED, Cause, Reason, Status
from pincal.result_table import Column, Kind, Table
from pincal.units import Quantity, fixed

WEAK = Reason(Cause.UNINFORMED, size=1e-6, unit="rad/(N m)")
ROWS = (
    ParameterRow("joint_1.theta", "rad", 0.0, 1.23456e-3, 2.5e-6, Status.IDENTIFIED, IDENTIFIED),
    ParameterRow("joint_2.k_z", "rad/(N m)", 0.0, 1.5e-6, 2e-8, Status.PRIOR, WEAK),
    ParameterRow("joint_3.k_z", "rad/(N m)", 0.0, 2.5e-6, 2e-8, Status.PRIOR, WEAK),
    ParameterRow("tool.x", "m", 0.1, 0.1, None, Status.FIXED, Reason(Cause.GIVEN)),
)
STATISTICS = {f"{name}_mm": 0.1 * k for k, name in enumerate(("mean", "median", "rms", "p95", "max"), 1)}


class Cells(HTMLParser):
    """Text of the cells of a table, row by row."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Begin a row or a cell."""
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        # Where a line may break, the text goes on.
        self._inside = tag in ("td", "th") or (self._inside and tag == "wbr")

    def handle_endtag(self, tag):
        """End a cell."""
        self._inside = False

    def handle_data(self, data):
        """Collect the text of a cell."""
        if self._inside:
            self.rows[-1][-1] += data


def tables() -> list[Table]:
    """Return tables of every kind of column."""
    ap = {"mean": 0.1, "max": 0.2}
    iso = {"poses": {"train": 3}, "calibrated": {"train": {"AP_mm": ap, "RP_mm": ap}}}
    return [
        parameter_table(ROWS),
        error_table({"nominal": {"test": STATISTICS}, "calibrated": {"test": STATISTICS}}),
        iso9283_table(iso),
        correlation_table([{"parameters": ["joint_1.d", "joint_2.d"], "correlation": -0.95}]),
    ]


@pytest.mark.parametrize("table", tables(), ids=lambda table: table.title)
def test_every_rendering_shows_every_cell(table: Table) -> None:
    """Terminal, plain text and page show the same text in every cell; headings carry the units."""
    cells = Cells(table.to_html()).rows
    assert cells == [[column.heading for column in table.columns], *table.texts()]
    screen = Console(file=io.StringIO(), width=200)
    screen.print(table)
    for shown in (screen.file.getvalue(), str(table)):
        assert all(text in shown for row in table.texts() for text in row)


def test_remarks_are_footnotes_once_each() -> None:
    """Rows that share a reason share the number of its footnote."""
    text = str(parameter_table(ROWS))
    assert text.count("the data add nothing to the prior (sigma 1 µrad/(N m))") == 1 and text.count("(1)") == 3
    assert "fixed (2)" in text and "identified (" not in text


@pytest.mark.parametrize("table", tables(), ids=lambda table: table.title)
def test_data_survive_csv_and_frames(table: Table) -> None:
    """CSV and polars hold the numbers themselves, quantities in SI units, not their display."""
    read = list(csv.DictReader(io.StringIO(table.to_csv())))
    frame = table.to_polars()
    assert isinstance(frame, pl.DataFrame) and len(read) == len(frame) == len(table)
    for line, record, named in zip(read, table.records(), frame.iter_rows(named=True), strict=True):
        for heading, value in record.items():
            assert named[heading] == value
            assert line[heading] == "" if value is None else type(value)(line[heading]) == value
    assert table.records()[0] != {} and not any(isinstance(v, Quantity) for r in table.records() for v in r.values())


def test_pandas_takes_the_same_data() -> None:
    """With pandas installed a table is a frame with the same columns and numbers."""
    pytest.importorskip("pandas", reason="pandas is optional")
    frame = parameter_table(ROWS).to_pandas()
    assert frame["value"].tolist() == [row.value for row in ROWS] and list(frame["unit"]) == [row.unit for row in ROWS]


def test_parameters_are_shown_in_readable_units() -> None:
    """Radians are shown in mrad, metres in mm, compliances in µrad/(N m), and no sigma as a dash."""
    texts = {row[0]: row[1:5] for row in parameter_table(ROWS).texts()}
    assert texts["joint_1.theta"] == ["mrad", "0.0000", "1.2346", "0.0025"]
    assert texts["joint_2.k_z"] == ["µrad/(N m)", "0.0000", "1.5000", "0.020"]
    assert texts["tool.x"] == ["mm", "100.0000", "100.0000", "-"]


def test_a_notebook_shows_markup_as_text() -> None:
    """Names that would be mark-up are escaped in titles, headings, cells and notes."""
    hostile = "<script>alert(1)</script>"
    table = Table(hostile, (Column(hostile), Column("n", kind=Kind.NUMBER, show=fixed(1))), ((hostile, 1.0),), (hostile,))
    assert "<script" not in table._repr_html_() and table._repr_html_().count("&lt;script&gt;") == 5


def test_columns_can_be_left_out() -> None:
    """A table without some columns keeps the others in order."""
    table = parameter_table(ROWS).without("nominal", "value")
    assert [column.name for column in table.columns] == ["parameter", "unit", "sigma", "status", "reason"]
    assert table.records()[0] == {
        "parameter": "joint_1.theta",
        "unit": "rad",
        "sigma": 2.5e-6,
        "status": "identified",
        "reason": "",
    }
