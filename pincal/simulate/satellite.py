"""What the simulator hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "simulate": "pincal.simulate.cli.simulate:simulate",
    },
}
