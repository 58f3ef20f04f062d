"""What work on fleets hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "fleet": "pincal.fleet.cli.fleet:fleet",
        "interim": "pincal.fleet.cli.interim:interim_verb",
    },
    "schemas": {"type": "pincal.fleet.robot_type:RobotType"},
    "priors": {"type": "pincal.fleet.cli.type_prior:TypePrior.load"},
}
