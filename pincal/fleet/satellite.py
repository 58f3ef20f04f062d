"""What fleets hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "schemas": {"type": "pincal.fleet.robot_type:RobotType"},
}
