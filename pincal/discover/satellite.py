"""What discovery hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "discover": "pincal.discover.cli.search_verb:discover",
    },
}
