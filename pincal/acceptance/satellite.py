"""What acceptance tests hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "options": {"Acceptance": "pincal.acceptance.cli.acceptance_options:AcceptanceOptions"},
}
