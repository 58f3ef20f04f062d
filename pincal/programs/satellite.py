"""What programs of controllers hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "formats": {"page": "pincal.programs.js_source:CorrectorPage"},
    "options": {
        "Programs of controllers": "pincal.programs.cli.controller_programs:ProgramOptions"
    },
}
