"""What discovery hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "prechecks": {"detectable": "pincal.discover.report.detectability_tables:Outlook.of"},
    "verbs": {
        "discover": "pincal.discover.cli.search_verb:discover",
    },
    "schemas": {"discovery": "pincal.discover.discovery_file:Findings"},
    "drawings": {"Discovery": "pincal.discover.report.found_drawings:discovery_drawings"},
}
