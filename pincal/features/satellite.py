"""What measuring a part hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {"measure": "pincal.features.cli.measure:measure_verb"},
    "schemas": {"measured": "pincal.features.measured_file:MeasuredFile"},
}
