"""Reasons and notes are data: every kind has words, and the words hold the figures."""

import string
from dataclasses import replace

import pytest

from pincal.calibration.caveats import Caveat, CaveatKind, findings_on_replicates
from pincal.identify.explain import IDENTIFIED, Cause, Combination, Reason, Status
from pincal.validate.lack_of_fit import Degrees, LackOfFit

FULL = {
    "parameters": ("a.d", "b.d", "c.d"),
    "combination": Combination("a.d", -1.0, "b.d"),
    "size": 3e-3,
    "narrowed": 2e-3,
    "unit": "m",
    "axis": "x",
}


@pytest.mark.parametrize("cause", [cause for cause in Cause if cause is not Cause.NONE])
def test_every_cause_has_words(cause: Cause) -> None:
    """A reason with all figures is a sentence without a gap, no two alike."""
    words = str(Reason(cause, **FULL))
    assert words and "{" not in words and "None" not in words and not words.endswith(tuple(string.whitespace))
    assert sum(str(Reason(other, **FULL)) == words for other in Cause) == 1


def test_words_hold_the_figures() -> None:
    """Sizes stand in readable units, moments in N m, combinations with their factor."""
    assert str(IDENTIFIED) == ""
    weak = Reason(Cause.WEAK, size=3e-3, narrowed=2e-3, unit="rad", moment=12.34)
    assert (
        str(weak) == "the data narrow the prior only from sigma 3 mrad to 2 mrad "
        "(static moment about this axis: at most 12 N m)"
    )
    assert str(Reason(Cause.AT_BOUND, size=0.01, unit="m")) == "stopped at its bound of 10 mm"
    for factor, words in ((1.0, "a.d + b.d"), (-1.0005, "a.d - b.d"), (-0.5, "a.d - 0.5 x b.d")):
        assert str(Combination("a.d", factor, "b.d")) == words
    assert str(Reason(Cause.TOOL)) == "the unknown tool frame absorbs it"
    words = str(Reason(Cause.TOOL, unknowns="the unknown points"))
    assert words == "the unknown tool frame and the unknown points absorb it"


@pytest.mark.parametrize(
    ("names", "words"),
    [(("a.d",), "a.d"), (("a.d", "b.d"), "a.d and b.d together"), (("a.d", "b.d", "c.d"), "a.d, b.d and c.d together")],
)
def test_aliases_are_listed(names: tuple[str, ...], words: str) -> None:
    """One, two or several parameters with the same effect are named as one would write it."""
    assert str(Reason(Cause.ALIASED, names)) == f"indistinguishable from {words}"


def test_a_status_is_its_word_in_the_file() -> None:
    """Files and users of earlier versions compare with these strings."""
    assert {str(status) for status in Status} == {"identified", "prior", "fixed", "unidentifiable", "at bound"}
    assert Status("at bound") is Status.AT_BOUND


LACK = LackOfFit(F=3.0, p_value=1.0, degrees=Degrees(60.0, 870.0), evenness=1.0, poses=8, pure_error={"sigma_m": 5e-5})


@pytest.mark.parametrize(
    ("lack", "declared", "kind"),
    [
        (None, 1e-9, None),
        (0.2, None, None),
        (0.2, 0.2, None),
        (1e-6, None, CaveatKind.LACK_OF_FIT),
        (1e-6, 1e-9, CaveatKind.LACK_OF_FIT),
        (0.2, 1e-9, CaveatKind.NOISY_REPLICATES),
    ],
)
def test_replicates_decide_between_model_and_noise(
    lack: float | None, declared: float | None, kind: CaveatKind | None
) -> None:
    """Lack of fit blames the model; residuals beyond the declared noise without lack of fit blame the noise."""
    found = findings_on_replicates(None if lack is None else replace(LACK, p_value=lack), declared)
    assert [note.kind for note in found] == ([] if kind is None else [kind])
    assert all("F(60, 870) = 3" in str(note) for note in found)


@pytest.mark.parametrize("kind", list(CaveatKind))
def test_every_note_has_words(kind: CaveatKind) -> None:
    """The figures named in the text of a note are all it needs; without them nothing is said."""
    names = {name for _, name, _, _ in string.Formatter().parse(kind.value) if name}
    text = str(Caveat(kind, {name: 4.0 for name in names}))
    assert text and "{" not in text and ("4" in text) == bool(names)
