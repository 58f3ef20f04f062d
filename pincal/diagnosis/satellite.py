"""What diagnosis hands in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "verbs": {
        "diagnose": "pincal.diagnosis.cli.new_rows:diagnose_verb",
        "update": "pincal.diagnosis.cli.new_rows:update_verb",
    },
    "schemas": {"diagnosis": "pincal.diagnosis.diagnosis_file:DiagnosisFile"},
}
