"""What motion hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "logs": {"session": "pincal.motion.session_reader:SESSIONS"},
    "options": {"Motion": "pincal.motion.cli.motion_options:MotionOptions"},
}
