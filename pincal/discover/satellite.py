"""What discovery hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "discover": "pincal.discover.cli.search_verb:discover",
    },
    "schemas": {"discovery": "pincal.discover.discovery_file:Findings"},
    "drawings": {"Discovery": "pincal.discover.report.found_drawings:discovery_drawings"},
}
