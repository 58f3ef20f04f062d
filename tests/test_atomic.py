"""Files appear whole or not at all."""

import os
from pathlib import Path

import pytest

from pincal.atomic import replacing, write_atomic
from pincal.errors import OutputError


def test_a_failure_leaves_the_old_file_and_no_draft(tmp_path: Path) -> None:
    """An error while writing, of whatever kind, passes on and changes nothing."""
    file = tmp_path / "a.csv"
    write_atomic(file, "old\n")
    with pytest.raises(RuntimeError, match="halfway"), replacing(file) as draft:
        draft.write_text("half")
        assert draft.suffix == ".csv"
        raise RuntimeError("halfway")

    assert file.read_bytes() == b"old\n"
    assert list(tmp_path.iterdir()) == [file]


def test_a_place_that_can_not_be_written_to_is_named_with_what_to_do(tmp_path: Path) -> None:
    """No folder, or a folder where the file should be, is an error of the output."""
    (tmp_path / "folder").mkdir()
    for place in (tmp_path / "absent" / "a", tmp_path / "folder"):
        with pytest.raises(OutputError, match=f"{place}: can't be written .*; try elsewhere"):
            write_atomic(place, b"x", advice="try elsewhere")

    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="this system has no /proc")
def test_a_folder_in_which_nothing_can_be_created_is_named() -> None:
    """One that exists and says of every new name that there is no such file; formerly tried for ever."""
    with pytest.raises(OutputError, match=r"/proc/x\.csv: can't be written \(no file can be created in this folder"):
        write_atomic("/proc/x.csv", b"x")


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    """A pipe stays a pipe; a device such as the system's bin would be lost for everybody."""
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="a device or a pipe"), replacing(pipe):
        pass

    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]
