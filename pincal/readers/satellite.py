"""What the readers hand in to the kernel."""

from pincal.satellites import HandedIn

HANDED_IN: HandedIn = {
    "sheets": {
        "recordings of ROS": "pincal.readers.recordings:RECORDINGS",
        "data sets of LeRobot": "pincal.readers.data_sets:DATA_SETS",
        "nested values": "pincal.readers.nested_sheet:NESTED",
    },
}
