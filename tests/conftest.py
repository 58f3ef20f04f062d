"""Fixtures shared by all tests."""

import ast
import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from pathlib import Path
from typing import Any

# No cell file is found or written by commands but where a test asks for one.
os.environ["PINCAL_CELL"] = "none"
# One thread a process, as several run at once; read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What other packages add to Hypothesis, such as trio, no test uses; read when it is loaded.
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")

import numpy as np
import pytest
from machines import kuka as true_kuka
from rooms import changed_since, is_concerned
from trees import parsed

# Imported for the effects, which it registers.
import pincal.model.catalogue  # noqa: F401
from pincal import plugins
from pincal.builtin import kuka_urdf_path
from pincal.model.effect_registry import EFFECTS
from pincal.report import illustrations
from pincal.robot.robot import Robot
from pincal.sensors.registry import SENSORS
from pincal.simulate import TrueMachine

# Data that is not part of the project stands next to it.
SHARED = Path(__file__).resolve().parents[2] / "shared"
COMPILING = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let a run leave out what a change can't concern."""
    parser.addoption("--since", metavar="COMMIT", help="leave out tests whose rooms are as they were in this commit")


def pytest_configure(config: pytest.Config) -> None:
    """Compile beside the collection of tests, which takes as long: each worker would do so for itself."""
    if config.getoption("numprocesses", None):
        config.stash[COMPILING] = subprocess.Popen([sys.executable, Path(__file__).with_name("compile_loops.py")])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Let no worker begin before the loops are compiled."""
    if COMPILING in node.config.stash:
        node.config.stash[COMPILING].wait()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Let the collector of garbage pass over all tests, which stay to the end, and look for garbage less often."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 10, 10)
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest; leave out tests whose rooms are named, if git says that nothing in these has changed."""
    items.sort(key=lambda item: item.get_closest_marker("first") is None)
    commit = config.getoption("--since")
    changed = changed_since(commit, config.rootpath) if commit else None
    if changed is None:
        return
    left_out = [item for item in items if not is_concerned(item, changed)]
    items[:] = [item for item in items if is_concerned(item, changed)]
    config.hook.pytest_deselected(items=left_out)


@pytest.fixture(scope="session")
def kuka() -> Robot:
    """Return the built-in KUKA KR 125/2 of the paper."""
    return Robot.from_urdf(kuka_urdf_path())


@pytest.fixture(scope="session")
def machine() -> TrueMachine:
    """Return a true KUKA whose lengths are off by a millimetre and angles by a milliradian."""
    return true_kuka().draw_errors(np.random.default_rng(4), sigma_length=1e-3, sigma_angle=1e-3)


@pytest.fixture(autouse=True)
def forget_plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let no test meet the effects and sensors of another's plugins, and no worker look for these: files may be gone."""
    monkeypatch.setattr(plugins, "_loaded", dict(plugins._loaded))
    known, imported = [(registry, set(registry.known())) for registry in (EFFECTS, SENSORS)], sys.modules.copy()
    yield
    for registry, names in known:
        for name in registry._classes.keys() - names:
            module = registry._classes.pop(name).__module__
            if module not in imported:
                # Loaded again, it has to register its classes again.
                sys.modules.pop(module, None)


@pytest.fixture(scope="module", autouse=True)
def inline_svg(request: pytest.FixtureRequest) -> Iterator[Callable[..., str]]:
    """Compose the figures of pages, and draw them in modules with the mark ``drawn``; return what draws them.

    Matplotlib would take half of the time of a calibration of few rows, and most tests look at words and numbers.
    """
    with pytest.MonkeyPatch.context() as patch:
        draws = illustrations.inline_svg
        if request.node.get_closest_marker("drawn") is None:
            patch.setattr(illustrations, "inline_svg", lambda *_, **__: '<svg role="img"></svg>')
        yield draws


@pytest.fixture
def drawn(inline_svg: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the figures of pages in a test."""
    monkeypatch.setattr(illustrations, "inline_svg", inline_svg)


class Here(Executor):
    """Does tasks at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return what a task has come to."""
        done = Future[Any]()
        done.set_result(fn(*args, **kwargs))
        return done


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands do here what they spread over processes, each of which would import the library first."""
    monkeypatch.setattr("pincal.cli.fitting.own_processes", lambda: nullcontext(Here()))


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that begins anew in every test."""
    return np.random.default_rng(20240607)


@pytest.fixture(scope="session")
def tests() -> dict[str, bool]:
    """Return the names of all tests, and whether they are long."""
    return {
        test.name: any(ast.unparse(mark) == "pytest.mark.long" for mark in test.decorator_list)
        for file in Path(__file__).parent.glob("test_*.py")
        for test in parsed(file.read_text(encoding="utf-8")).body
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_")
    }


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of measurements on real machines; skip the test where it is absent."""
    return _folder("data", "measurements on real machines")


@pytest.fixture(scope="session")
def published_robots() -> Path:
    """Return the folder of robot descriptions as they are published; skip the test where it is absent."""
    return _folder("robots", "published robot descriptions")


@pytest.fixture(scope="session")
def hidden_examples() -> Path:
    """Return the folder of simulated cases with an undisclosed effect; skip the test where it is absent."""
    return _folder("hidden_examples", "cases with a hidden effect")


@pytest.fixture(scope="session")
def change_examples() -> Path:
    """Machines measured again after a change."""
    return _folder("change_examples", "cases of a changed robot")


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """Return the folder of tables of measuring plans and their mistakes; skip the test where it is absent."""
    return _folder("cases", "tables of measuring plans")


def _folder(name: str, what: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip(f"{what} are not here: no folder shared/{name} next to the project")
    return path


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return a headless Chromium driven by Selenium, its log of the console on; skip the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="no Selenium here: pip install -e '.[test]'")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no Chromium with its chromedriver here: nothing to open a page with")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    profile = tmp_path_factory.mktemp("chromium")
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-unsafe-swiftshader",
        "--disable-dev-shm-usage",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--window-size=1280,800",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    window = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=driver))
    try:
        yield window
    finally:
        window.quit()
