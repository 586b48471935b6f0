"""Test the wheel and the source archive: contents, use with and without extras, and installed size."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from icrl4aht_data import __version__
from icrl4aht_data.utils.install_hints import install_command
from tests.helpers.paths import PACKAGES as SOURCES
from tests.helpers.paths import ROOT
from tests.helpers.tiny import TINY
from tests.packaging.test_readme import README, shell_calls

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
READER = "icrl4aht_data"
PACKAGES = {name: folder for name, folder in SOURCES.items() if name.startswith(READER.split("_")[0])}
"""Import name -> folder of the three packages."""
NAME, VERSION = PROJECT["project"]["name"], __version__

pytestmark = pytest.mark.slow

PYTHONS = ("3.11", "3.12", "3.13")
CODE_BYTES, RELEASE_BYTES, MODEL_BYTES = 4_000_000, 16_000_000, 2_000_000
"""Size limits of the installed packages without what is bundled, of the bundled release, and of a bundled model of one
track."""
ENVIRONMENT_BYTES = 250_000_000
"""Size limit of the package with its dependencies."""

UNREACHABLE = ("NewConnectionError", "NameResolutionError", "ConnectTimeoutError", "dns error", "Connection refused")

USE = """
import hashlib, json, sys
from icrl4aht_data import load_icrl4aht, verify_release

dataset = load_icrl4aht(split="train", layout="coord_simple")
ad = dataset.ad(batch_size=2, length=50, seed=0)[0]
dpt = dataset.dpt(batch_size=2, context=20, seed=0)[0]
history = dataset[0]
print(json.dumps({
    "histories": len(load_icrl4aht()),
    "ok": verify_release(level="quick").ok,
    "ad": [list(ad.obs.shape), hashlib.sha256(ad.obs.tobytes() + ad.target_actions.tobytes()).hexdigest()],
    "dpt": [list(dpt.query_obs.shape), hashlib.sha256(dpt.query_obs.tobytes()).hexdigest()],
    "return": float(history.returns()[-1]),
    "heavy": sorted({"jax", "torch", "matplotlib", "datasets", "huggingface_hub"} & sys.modules.keys()),
}))
"""

EVALUATE = """
import sys
from importlib.util import find_spec

import numpy as np

from icrl4aht_baselines.agents import from_host
from icrl4aht_baselines.evaluate import evaluate, get_protocol
from icrl4aht_generation.teammates.instances import published_tasks


class MyAgent:
    def reset(self, batch):
        self.rng = np.random.default_rng(0)

    def act(self, ego_input):
        return self.rng.integers(0, 6, len(ego_input.obs))


tasks = [task for task in published_tasks("teammate") if task.layout.name == "demo_wide"]
protocol = get_protocol("seeded", episodes=2)
results = evaluate("mine", from_host(MyAgent()), tasks[:2], protocol, details={"trained_on": []})
assert len(results) == 2
assert not find_spec("matplotlib") and "PIL" not in sys.modules
"""
"""Code that evaluates a user's agent without drawing anything."""


def run_isolated(*command: str | Path, **options) -> subprocess.CompletedProcess:
    """Run a command without the environment variables whose names start with PYTHON."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= options.pop("env", {})
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, env=environment, **options)


def install_packages(*arguments: str | Path) -> None:
    """Install packages with uv if available, else with pip; skip the test if the registry cannot be reached."""
    uv = Path(sys.executable).with_name("uv")
    python, *rest = arguments
    if uv.exists():
        done = run_isolated(uv, "pip", "install", "--quiet", "--python", python, *rest)
    else:
        pip = ("-m", "pip", "--python", python, "--disable-pip-version-check")
        done = run_isolated(sys.executable, *pip, "install", "--quiet", "--no-compile", *rest)
    if any(sign in done.stderr for sign in UNREACHABLE):
        pytest.skip("the package registry cannot be reached")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def build_backend_folder(tmp_path_factory) -> Path:
    """Return a folder with the installed build requirements."""
    folder = tmp_path_factory.mktemp("backend")
    install_packages(sys.executable, "--target", folder, *PROJECT["build-system"]["requires"])
    return folder


def build_archive(build_backend_folder: Path, source: Path, target: Path, kind: str) -> Path:
    """Build the wheel or the source archive of a folder, and return its path."""
    command = (sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", target)
    done = run_isolated(*command, cwd=source, env={"PYTHONPATH": str(build_backend_folder)})
    assert done.returncode == 0, done.stderr
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope="session")
def sdist(build_backend_folder, tmp_path_factory) -> Path:
    """Return the folder of the unpacked source archive."""
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(build_archive(build_backend_folder, ROOT, folder / "packed", "sdist")) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"{READER}-{VERSION}"


@pytest.fixture(scope="session")
def wheel(build_backend_folder, sdist, tmp_path_factory) -> Path:
    """Return the path of the wheel, which is built from the unpacked source archive, not from the repository."""
    return build_archive(build_backend_folder, sdist, tmp_path_factory.mktemp("wheel"), "wheel")


def files_below(folder: Path) -> set[str]:
    """Return the relative paths of all files except hidden files and caches."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix() for path in paths}
    return {name for name in names if not any(part.startswith((".", "__pycache__")) for part in Path(name).parts)}


def test_the_wheel_contains_the_packages_and_nothing_else(wheel):
    about = f"{READER}-{VERSION}.dist-info"
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.startswith(f"{about}/")}
        metadata, scripts = (archive.read(f"{about}/{name}").decode() for name in ("METADATA", "entry_points.txt"))
        assert f"{about}/licenses/LICENSE" in archive.namelist()
    cards = {f"{READER}/cards/{name}" for name in {*files_below(ROOT / "cards"), "LICENSE", "CITATION.cff"}}
    own = {f"{package}/{name}" for package, folder in PACKAGES.items() for name in files_below(folder)}
    assert names == own | cards
    data = ("mini/MANIFEST.sha256", "manifests/teammate_test.jsonl", "cards/dataset.md", "py.typed")
    assert {f"{READER}/{name}" for name in data} <= names
    assert f"Name: {NAME}\nVersion: {VERSION}\n" in metadata
    assert "License-Expression: MIT" in metadata
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert f"Author: {cited['authors'][0]['name']}\n" in metadata
    assert (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[0] in metadata
    for script, target in PROJECT["project"]["scripts"].items():
        assert f"{script} = {target}\n" in scripts


def test_the_source_archive_is_complete(sdist):
    for folder in (READER, "generation", "baselines", "benchmarks", "cards", "docs", "tests"):
        assert files_below(ROOT / folder) == files_below(sdist / folder), folder
    assert {"LICENSE", "CITATION.cff", "CHANGELOG.md", "README.md", "Makefile", "pyproject.toml"} <= files_below(sdist)
    assert not {".git", ".venv", "build", "dist", "runs"} & {path.name for path in sdist.iterdir()}


def make_virtual_environment(version: str, folder: Path, package: str | Path) -> Path:
    """Create an environment with only a package and its dependencies; return the folder of its commands.

    The test is skipped if there is no working Python of the given version.
    """
    python = sys.executable if sys.version.startswith(f"{version}.") else shutil.which(f"python{version}")
    if python is None or run_isolated(python, "--version").returncode != 0:
        pytest.skip(f"no Python {version} on the PATH")
    made = run_isolated(python, "-m", "venv", "--without-pip", folder)
    assert made.returncode == 0, made.stderr
    install_packages(folder / "bin" / "python", package)
    return folder / "bin"


@pytest.fixture(scope="module", params=PYTHONS)
def bare_environment(request, wheel, tmp_path_factory) -> Path:
    """Return the folder of commands of an environment with only the wheel and its dependencies."""
    return make_virtual_environment(request.param, tmp_path_factory.mktemp("bare"), wheel)


@pytest.fixture(scope="module", params=PYTHONS)
def jax_environment(request, wheel, tmp_path_factory) -> Path:
    """Return the folder of commands of an environment with the extra `jax`; tests may add other extras."""
    return make_virtual_environment(request.param, tmp_path_factory.mktemp("jax"), f"{NAME}[jax] @ {wheel.as_uri()}")


Run = Callable[..., str]


def command_runner(commands: Path, folder: Path) -> Run:
    """Return a function that runs a command of an environment, checks its exit code and returns its output."""

    def run(*command: str | Path, code: int = 0, **env: str) -> str:
        done = run_isolated(commands / command[0], *command[1:], cwd=folder, env={"HOME": str(folder), **env})
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr

    return run


def test_the_reader_works_without_extras(bare_environment, wheel, tmp_path):
    run = command_runner(bare_environment, tmp_path)
    used = json.loads(run("python", "-c", USE))
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(USE, {})
    assert used["ok"]
    assert used == json.loads(printed.getvalue()) | {"heavy": []}, "the same batches everywhere"

    assert run("icrl4aht-data", "--version") == f"{NAME} {VERSION}\n"
    assert "coord_simple" in run("icrl4aht-data", "list")
    assert ": valid; checked" in run("icrl4aht-data", "verify")
    report = run("icrl4aht-data", "doctor")
    assert "no problems found" in report
    assert "jax" not in report.partition("Devices")[2]
    assert re.search(r"jax: not installed: .*baselines", report)
    for extra in ("baselines", "plot", "hf", "s3"):
        assert f": not installed: {install_command(extra)}\n" in report
    assert run("icrl4aht-data", "show", "--plot", "curves.png", code=1).endswith(f": {install_command('plot')}\n")
    assert not list(tmp_path.glob("*.png"))


def test_user_packages_named_like_folders_of_the_project_do_not_break_commands(bare_environment, tmp_path):
    """A user's packages `baselines` and `generation` can be imported, and the command line still works."""
    for name in ("baselines", "generation"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("mine = True\n")
    run = command_runner(bare_environment, tmp_path)
    run("python", "-c", "import baselines, generation; assert baselines.mine and generation.mine")
    assert "evaluate" in run("python", "-m", "icrl4aht_data", "--help")


def test_training_and_drawing_need_only_the_extras_that_messages_name(jax_environment, wheel, tmp_path):
    """The extra `jax` is enough to train and evaluate models; drawing needs the install command shown in messages."""
    run = command_runner(jax_environment, tmp_path)
    run("python", "-c", EVALUATE)
    assert "ad-reference" in run("icrl4aht-data", "models")
    small = ("--layout", "demo_wide", "--tasks", "1", "--episodes", "2")
    run("icrl4aht-data", "evaluate", "--agent", "ad-reference", *small, "--out", "results")
    settings = ("--layout", "demo_wide", "--steps", "2", "--batch-size", "2", "--context", "20")
    trained = run("icrl4aht-data", "train", "ad", *settings, "--out", "run")
    assert f"curves.png was not drawn, matplotlib is not installed: {install_command('plot')}" in trained
    assert not list(tmp_path.rglob("*.png"))
    generate = ("icrl4aht-data", "generate", "--profile", "smoke", "--out", "rebuilt")
    assert "pip install" in run(*generate, code=1)
    assert not (tmp_path / "rebuilt").exists()

    install_packages(jax_environment / "python", *shlex.split(install_command("baselines"))[2:])
    run("icrl4aht-data", "report", "results")
    assert "demo_wide" in (tmp_path / "results" / "report" / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "results" / "report" / "report.csv").stat().st_size > 500


QUICK_OPTIONS = {
    "browse": "",
    "train": "--steps 2 --batch-size 2 --context 20 --width 16 --heads 2",
    "evaluate": "--tasks 1 --episodes 2",
    "generate": "--profile tiny.toml",
    "release": "",
}
"""Command of the README -> options that shorten it, given after the options that the README shows."""


def test_the_five_commands_of_the_readme_run_after_its_install_command(jax_environment, wheel, tmp_path):
    """The environment is that of the test before, which installed the extra `baselines`."""
    (extras,) = re.findall(r"^pip install '\.(\[.*?\])'", README, re.MULTILINE)
    assert extras == "[baselines,hf]"
    install_packages(jax_environment / "python", f"{NAME}{extras} @ {wheel.as_uri()}")
    run = command_runner(jax_environment, tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY, encoding="utf-8")
    calls = shell_calls(README.partition("## Five commands")[2])
    assert [arguments[0] for arguments in calls] == list(QUICK_OPTIONS)
    for arguments in calls:
        run("icrl4aht-data", *arguments, *QUICK_OPTIONS[arguments[0]].split())
    for name in ("browse.html", "runs/ad/config.json", "runs/results/tasks", "build/smoke/lite", "build/release"):
        assert (tmp_path / name).exists(), name


def test_the_installed_size_is_limited(bare_environment, capsys):
    (site,) = bare_environment.parent.glob("lib/python*/site-packages")
    files = (path for path in site.rglob("*") if path.is_file())
    # Bytecode is not counted, because its size depends on the tests that imported the package before.
    sizes = {path: path.stat().st_size for path in files if path.suffix != ".pyc"}
    own = sum(size for path, size in sizes.items() if path.relative_to(site).parts[0].startswith(tuple(PACKAGES)))
    with capsys.disabled():
        print(f"\n{NAME}: {own:,} bytes installed, {sum(sizes.values()):,} with its dependencies ({site.parent.name})")
    release, *models = (
        sum(size for path, size in sizes.items() if path.is_relative_to(folder))
        for folder in (site / READER / "mini", *sorted((site / "icrl4aht_baselines" / "models").glob("*/*/")))
    )
    assert own - release - sum(models) <= CODE_BYTES
    assert 0 < release <= RELEASE_BYTES
    # One model has a training run per track, and three models have a single run for all tracks.
    assert len(models) == 5 and all(0 < model <= MODEL_BYTES for model in models)
    assert sum(sizes.values()) <= ENVIRONMENT_BYTES
    page = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    stated = re.search(r"(\d+) MB\s+installed, (\d+) MB with the required dependencies", page)
    assert stated, "docs/start.md states both sizes"
    for said, found in zip(stated.groups(), (own, sum(sizes.values())), strict=True):
        assert abs(1e6 * int(said) - found) <= 0.1 * found, f"docs/start.md: {said} MB"
