"""What certificates hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "certificate": "pincal.certificate.cli.certify:certificate",
    },
}
