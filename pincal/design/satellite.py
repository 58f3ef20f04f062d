"""What design hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "design": "pincal.design.cli.planning:design",
    },
}
