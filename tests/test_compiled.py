"""Compiled loops: what is kept of them between runs is used if it is whole, and compiled anew if it isn't."""

import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import config
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import pincal
from pincal.compiled import _Cache

_LOOP = """
from pincal.compiled import compiled

@compiled(nogil=True)
def tripled(x):
    return 3.0 * x
"""


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _empty(content: bytes) -> bytes:
    return b""


def _zeros(content: bytes) -> bytes:
    return bytes(len(content))


def _noise(content: bytes) -> bytes:
    return np.random.default_rng(1).bytes(len(content))


def _one_bit(content: bytes) -> bytes:
    # Within the machine code, which makes up most of the file: what reads it has no reason to stumble.
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """Return what a new process has: the loop of a file, which was never called."""
    monkeypatch.setattr(config, "CACHE_DIR", "")
    path = tmp_path / "loop.py"
    path.write_text(_LOOP)

    def load() -> Any:
        spec = importlib.util.spec_from_file_location("loop", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.tripled

    return load


@pytest.mark.parametrize(
    ("damage", "suffix"),
    [
        *((how, "nbc") for how in (_cut, _zeros, _one_bit)),
        *((how, "nbi") for how in (_empty, _noise)),
        *(pytest.param(how, "nbi", marks=pytest.mark.long) for how in (_cut, _zeros)),
        *(pytest.param(how, "nbc", marks=pytest.mark.long) for how in (_empty, _noise)),
    ],
)
def test_a_damaged_file_is_compiled_anew(
    fresh: Callable[[], Any], tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Any, suffix: str
) -> None:
    """A file of the cache that was cut off or changed costs one compilation and one line of the log, once."""
    assert fresh()(2.0) == 6.0
    (kept,) = tmp_path.glob(f"__pycache__/*.{suffix}")
    kept.write_bytes(damage(kept.read_bytes()))

    with caplog.at_level(logging.INFO, "pincal"):
        again, after = fresh(), fresh()
        assert again(2.0) == 6.0 and after(2.0) == 6.0

    assert [sum(loop.stats.cache_misses.values()) for loop in (again, after)] == [1, 0]
    assert sum("recompiling" in record.message for record in caplog.records) == 1


def test_a_loop_is_compiled_anew_if_a_file_changed_that_it_has_parts_of(
    fresh: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a loop calls may stand in another file, and is compiled into it."""
    part, text = tmp_path / "part.py", "from numba import njit\n\n@njit\ndef scaled(x):\n    return {} * x\n"
    (tmp_path / "loop.py").write_text("from part import scaled\n" + _LOOP.replace("3.0 * x", "scaled(x)"))
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for factor in ("3.0", "3.0", "40.0"):
        if not part.exists() or factor not in part.read_text():
            part.write_text(text.format(factor))
        monkeypatch.delitem(sys.modules, "part", raising=False)
        importlib.invalidate_caches()
        loop = fresh()
        found.append((loop(2.0), sum(loop.stats.cache_misses.values())))
    assert found == [(6.0, 1), (6.0, 0), (80.0, 1)]


def test_a_loop_needs_no_place_to_be_kept(
    fresh: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where no folder can be written to, or it is full, loops are compiled in each run."""
    (tmp_path / "file").touch()
    with monkeypatch.context() as patch, caplog.at_level(logging.INFO, "pincal"):
        patch.setattr("numba.core.caching.CacheImpl._locator_classes", ())
        assert fresh()(2.0) == 6.0
    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile._open_for_write", _full_disk)
    with caplog.at_level(logging.INFO, "pincal"):
        assert fresh()(2.0) == 6.0

    assert [record.message.partition(":")[0] for record in caplog.records] == [
        "each run compiles its loops",
        "compiled loops can't be cached",
    ]


def _full_disk(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_all_that_is_kept_is_checked() -> None:
    """No loop of pincal is kept by numba's own cache, which believes every file."""
    package = Path(pincal.__file__).parent
    modules = [
        importlib.import_module(".".join(("pincal", *path.relative_to(package).with_suffix("").parts)))
        for path in package.rglob("*.py")
        if "compiled import compiled" in (text := path.read_text(encoding="utf-8")) or "numba import njit" in text
    ]
    loops = [value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)]

    assert len(loops) > 30
    assert {type(loop._cache) for loop in loops} == {NullCache, _Cache}
