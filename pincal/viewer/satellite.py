"""What the viewer hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "view": "pincal.viewer.cli.view_verb:view",
    },
    "views": {"view": "pincal.viewer.cli.calibration_views:write_views"},
}
