"""What a search says of a calibration: its verdict, what to do next, its section of the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pincal.discover.discovery_file import Findings, FoundEffect
from pincal.discover.report.found_words import effect_words
from pincal.discover.run import Discovery
from pincal.model.catalogue import untestable
from pincal.notes import doubts_of
from pincal.recorded import RECORDABLE
from pincal.report.blocks import Section
from pincal.report.judgement import Judged, see_doubts
from pincal.report.report_numbers import REPORT
from pincal.validate.misfit import Verdict


@dataclass(frozen=True)
class SearchAnswer:
    """What a discovery says of its calibration: a :class:`~pincal.report.judgement.SearchReport`.

    Attributes:
        discovery: the result of the search.
    """

    discovery: Discovery

    def judged(self) -> Judged:
        """Return whether the search has explained the data, and if not, why."""
        result = self.discovery.calibration.result
        compared = result.noise_test
        return verdict_of_search(
            self.discovery.findings,
            is_of_arrivals=result.arrivals is not None,
            is_within_noise=compared is not None and not compared.is_misfit,
        )

    def next_steps(self) -> Iterator[str]:
        """Yield how to distinguish what was found from its alternatives, and what to record."""
        yield from _next_steps(self.discovery)

    def section(self) -> Section:
        """Return what was found, for the page."""
        # Figures need matplotlib, which the verdict does not.
        from pincal.discover.report.found_section import found_section

        return found_section(self.discovery)


def verdict_of_search(
    found: Findings, *, is_of_arrivals: bool = False, is_within_noise: bool = False
) -> Judged:
    """Return whether a search has explained the data, and if not, why; perhaps because of how
    drives stop. Of residuals that a known noise explains, what is beyond it is chance.
    """
    n = len(found.effects)
    left = found.unexplained_mm
    added = (
        f"{n} effects were found and added"
        if n > 1
        else "One effect was found and added"
        if n
        else "Nothing was added"
    )
    beyond = f"{left:.3f} mm rms beyond the noise" if left >= REPORT.beyond_noise else ""
    if found.verdict is Verdict.ADEQUATE:
        chance = f": {beyond} may be chance" if beyond else ""
        return Judged(
            found.verdict, f"{added}; the remaining residuals are consistent with noise{chance}."
        )
    if found.verdict is Verdict.NOT_JUDGED:
        why = _why_not_judged(found, is_of_arrivals=is_of_arrivals)
        return Judged(found.verdict, f"{added}; {why}.")
    is_chance = is_within_noise and bool(doubts_of(found.warnings))
    wrong = _what_is_wrong(found, "" if is_chance else beyond)
    return Judged(found.verdict, f"{added}; {', and '.join(wrong)}.")


def _why_not_judged(found: Findings, *, is_of_arrivals: bool) -> str:
    if doubts_of(found.warnings):
        return "there are too few poses to judge whether that is all; see the doubt stated first"
    if is_of_arrivals:
        return (
            "what exceeds the declared noise of the instrument is as of drives that all stop "
            "unevenly, and hides smaller errors of the model: measure ten poses three times each"
        )
    return (
        "nothing more is detected, but noise estimated from the residuals can't show whether "
        "that is all: state the instrument's own (--noise), or measure ten poses three times"
    )


def _what_is_wrong(found: Findings, beyond: str) -> list[str]:
    """Return what a search has not explained; ``beyond`` are the errors beyond the noise, "" for
    none.
    """
    wrong = [f"{scatter.joint} scatters from reading to reading" for scatter in found.scatter]
    doubts = doubts_of(found.warnings)
    if beyond:
        wrong.append(f"{beyond} remain unexplained")
    elif not wrong and doubts:
        wrong.append(see_doubts(doubts).lower())
    elif not wrong:
        wrong.append(
            "some residuals are larger than the declared noise, or its estimate from neighbouring "
            "poses, allow, though not on average over all rows"
        )
    return wrong


def _apart(effects: Sequence[FoundEffect]) -> Iterator[str]:
    """Yield each measurement that would distinguish effects from their alternatives, once."""
    by_way: dict[str, list[str]] = {}
    for entry in effects:
        if entry.tell_apart:
            by_way.setdefault(entry.tell_apart, []).append(effect_words(entry))
    for way, names in by_way.items():
        whose = "its" if len(names) == 1 else "their"
        yield f"To distinguish {'; '.join(names)} from {whose} alternatives: {way}."


def _next_steps(discovery: Discovery) -> Iterator[str]:
    found = discovery.findings
    yield from _apart(found.effects)
    for scatter in found.scatter:
        yield f"Record {scatter.missing}: it may explain why {scatter.joint} scatters."
    if found.verdict is not Verdict.ADEQUATE:
        calibration = discovery.calibration
        stations = calibration.fit.problem.stations
        tables = [rows.train for rows in calibration.stations]
        lost = (
            pair
            for station in stations
            for pair in untestable(station.model.chain, station.conditions)
        )
        needed = {column for effect, _ in lost for column in effect.needs}
        absent = (
            column for column in needed if any(getattr(table, column) is None for table in tables)
        )
        if columns := ", ".join(
            sorted(
                {RECORDABLE[column].column if column in RECORDABLE else column for column in absent}
            )
        ):
            yield (
                f"Record {columns} with each pose, so that effects that depend on it can be tested."
            )
