"""What the demonstration hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "demo": "pincal.demo.cli.demo:demo",
    },
}
