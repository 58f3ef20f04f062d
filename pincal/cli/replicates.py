"""Accuracy and repeatability by ISO 9283, and lack of fit, on the terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from pincal.cli.screen import hanging, new_table
from pincal.validate.lack_of_fit import lack_words, pure_words
from pincal.validate.replicates import ANGLE_WORDS, cycle_words

_PARTS = {"train": "fitted", "test": "held out"}


def print_replicates(iso: dict[str, Any] | None, lack: dict[str, Any] | None, out: Console) -> None:
    """Print what poses that were visited more than once tell; nothing where there are none.

    Args:
        iso: ``iso9283`` of ``result.json``.
        lack: ``lack_of_fit`` of ``result.json``.
        out: where to.
    """
    if iso is not None:
        out.print(_visit_table(iso))
        out.print(hanging("cycles:", cycle_words(iso)))
    if lack is not None:
        out.print(hanging("lack of fit:", f"{lack_words(lack)} (by {pure_words(lack)})"))


def _visit_table(iso: dict[str, Any]) -> Table:
    """Return mean and largest AP and RP, position and each angle in lines of their own."""
    table = new_table("Pose accuracy AP and pose repeatability RP (ISO 9283)")
    for name in ("model", "poses", "unit"):
        table.add_column(name, no_wrap=True)
    for name in ("AP mean", "AP max", "RP mean", "RP max"):
        table.add_column(name, justify="right", no_wrap=True)
    for model in ("nominal", "calibrated"):
        for part, values in iso.get(model, {}).items():
            for key in (name for name in values if name.startswith("AP")):
                both = (values[key], values["R" + key[1:]])
                numbers = [f"{value[size]:.4f}" for value in both for size in ("mean", "max")]
                table.add_row(model, f"{iso['poses'][part]} {_PARTS[part]}", ANGLE_WORDS[key], *numbers)
    return table
