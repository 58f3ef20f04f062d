"""Files that come with pincal, in a source checkout or an installed wheel."""

from pathlib import Path

from pincal.errors import RobotFileError

_KUKA = "kuka_kr125_2.urdf"


def kuka_urdf_path() -> Path:
    """Return the path of the built-in URDF of the KUKA KR 125/2 (Table I of the paper, nominal
    values).

    Raises:
        RobotFileError: if the installation lacks the file.

    Example:
        >>> kuka_urdf_path().name
        'kuka_kr125_2.urdf'
    """
    package = Path(__file__).resolve().parent
    places = (package / "urdf" / _KUKA, package.parent / "urdf" / _KUKA)
    for path in places:
        if path.is_file():
            return path
    raise RobotFileError(
        f"built-in robot {_KUKA} not found at {' or '.join(map(str, places))}; reinstall pincal"
    )
