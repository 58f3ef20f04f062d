"""What diagnoses hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "schemas": {"diagnosis": "pincal.diagnosis.diagnosis_file:DiagnosisFile"},
}
