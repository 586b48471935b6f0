"""The wheel contains the reader and nothing else, and works in an environment with only its dependencies; the source
archive contains all that the wheel is built from.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.dataset import MINI
from icrl4aht_data.format.info import read_info
from tests.helpers.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGE = "icrl4aht_data"
NAME, VERSION = PROJECT["project"]["name"], PROJECT["project"]["version"]

pytestmark = pytest.mark.slow

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
CODE_BYTES, RELEASE_BYTES = 2_000_000, 16_000_000
"""Size limits of the installed package without the bundled release, and of the release."""
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


def call(*command: str | Path, **options) -> subprocess.CompletedProcess:
    """Run a command without this environment's Python variables."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= options.pop("env", {})
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, env=environment, **options)


def install(*arguments: str | Path) -> None:
    """Install with uv if this environment has it, else with pip; skip the test if the registry cannot be reached."""
    uv = Path(sys.executable).with_name("uv")
    python, *rest = arguments
    if uv.exists():
        done = call(uv, "pip", "install", "--quiet", "--python", python, *rest)
    else:
        pip = ("-m", "pip", "--python", python, "--disable-pip-version-check")
        done = call(sys.executable, *pip, "install", "--quiet", "--no-compile", *rest)
    if any(sign in done.stderr for sign in UNREACHABLE):
        pytest.skip("the package registry cannot be reached")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def backend(tmp_path_factory) -> Path:
    """A folder with the build requirements."""
    folder = tmp_path_factory.mktemp("backend")
    install(sys.executable, "--target", folder, *PROJECT["build-system"]["requires"])
    return folder


def build(backend: Path, source: Path, target: Path, kind: str) -> Path:
    """Build the wheel or the source archive of a folder."""
    command = (sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", target)
    done = call(*command, cwd=source, env={"PYTHONPATH": str(backend)})
    assert done.returncode == 0, done.stderr
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope="session")
def sdist(backend, tmp_path_factory) -> Path:
    """The source archive, unpacked."""
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(build(backend, ROOT, folder / "packed", "sdist")) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"{PACKAGE}-{VERSION}"


@pytest.fixture(scope="session")
def wheel(backend, sdist, tmp_path_factory) -> Path:
    """The wheel, built from the source archive as for publication."""
    return build(backend, sdist, tmp_path_factory.mktemp("wheel"), "wheel")


def files_below(folder: Path) -> set[str]:
    """Return the relative paths of all files that are not hidden or caches."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix() for path in paths}
    return {name for name in names if not any(part.startswith((".", "__pycache__")) for part in Path(name).parts)}


def test_the_wheel_contains_the_reader_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.startswith(f"{PACKAGE}-{VERSION}.dist-info/")}
        about = archive.read(f"{PACKAGE}-{VERSION}.dist-info/METADATA").decode()
        assert f"{PACKAGE}-{VERSION}.dist-info/licenses/LICENSE" in archive.namelist()
    cards = {f"cards/{name}" for name in {*files_below(ROOT / "cards"), "LICENSE", "CITATION.cff"}}
    assert names == {f"{PACKAGE}/{name}" for name in files_below(ROOT / PACKAGE) | cards}
    assert {f"{PACKAGE}/mini/MANIFEST.sha256", f"{PACKAGE}/py.typed", f"{PACKAGE}/cards/dataset.md"} <= names
    assert f"Name: {NAME}\nVersion: {VERSION}\n" in about
    assert "License-Expression: MIT" in about
    assert (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[0] in about


def test_the_source_archive_is_complete(sdist):
    for folder in (PACKAGE, "generation", "baselines", "benchmarks", "cards", "docs", "tests"):
        assert files_below(ROOT / folder) == files_below(sdist / folder), folder
    assert {"LICENSE", "CITATION.cff", "CHANGELOG.md", "README.md", "Makefile", "pyproject.toml"} <= files_below(sdist)
    assert not {".git", ".venv", "build", "dist", "runs"} & {path.name for path in sdist.iterdir()}


def find_python(version: str) -> str | None:
    """Return the path of a Python of this version that runs: this one, or one on the PATH."""
    if sys.version.startswith(f"{version}."):
        return sys.executable
    found = shutil.which(f"python{version}")
    return found if found and call(found, "--version").returncode == 0 else None


@pytest.fixture(scope="module")
def environments(wheel, tmp_path_factory) -> dict[str, Future[Path]]:
    """Environments with only the wheel and its dependencies, one for each installed version of Python."""

    def make(python: str, folder: Path) -> Path:
        made = call(python, "-m", "venv", "--without-pip", folder)
        assert made.returncode == 0, made.stderr
        install(folder / "bin" / "python", wheel)
        return folder / "bin"

    pythons = {version: find_python(version) for version in PYTHONS}
    with ThreadPoolExecutor() as pool:
        return {
            version: pool.submit(make, python, tmp_path_factory.mktemp(f"python{version}"))
            for version, python in pythons.items()
            if python is not None
        }


@pytest.fixture(scope="module", params=PYTHONS)
def installed(request, environments) -> Path:
    """The folder with the commands of one environment."""
    if request.param not in environments:
        absent = ", ".join(version for version in PYTHONS if version not in environments)
        pytest.skip(f"no Python {request.param} on the PATH; absent are {absent}")
    return environments[request.param].result()


def test_the_reader_works_without_extras(installed, tmp_path):
    def run(*command: str | Path, code: int = 0, **env: str) -> str:
        done = call(installed / command[0], *command[1:], cwd=tmp_path, env={"HOME": str(tmp_path), **env})
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr

    used, here = json.loads(run("python", "-c", USE)), load_icrl4aht(split="train", layout="coord_simple")
    assert used["histories"] == read_info(MINI).histories
    assert used["ok"] and used["heavy"] == []
    assert used["return"] == here[0].returns()[-1]
    batch = here.ad(batch_size=2, length=50, seed=0)[0]
    assert used["ad"][0] == list(batch.obs.shape)
    assert used == json.loads(call(sys.executable, "-c", USE, cwd=ROOT).stdout), "the same batches everywhere"

    assert run("icrl4aht-data", "--version") == f"{NAME} {VERSION}\n"
    assert "coord_simple" in run("icrl4aht-data", "list")
    assert ": valid; checked" in run("icrl4aht-data", "verify")
    report = run("icrl4aht-data", "doctor")
    assert "no problems found" in report
    assert "checkout no" in report
    assert "jax" not in report.partition("Devices")[2]
    assert re.search(rf"jax +not installed, expected >=0.8, extra generation, install pip install '{NAME}\[gen", report)
    assert f"pip install '{NAME}[plot]'" in run("icrl4aht-data", "show", "--plot", "curves.png", code=1)
    assert not list(tmp_path.glob("*.png"))


def test_commands_name_the_missing_extra(installed, tmp_path):
    """`generation` and `baselines` are not in the wheel; in a checkout they name the extra they need."""
    done = call(installed / "python", "-c", "import generation", cwd=tmp_path)
    assert "No module named 'generation'" in done.stderr
    python = (installed / "python", "-B")
    assert call(*python, "-c", "import generation, baselines", cwd=ROOT).returncode == 0
    for package in ("generation", "baselines"):
        assert call(*python, "-m", package, "--version", cwd=ROOT).stdout == f"{NAME} {VERSION}\n"
        assert "Examples:" in call(*python, "-m", package, "--help", cwd=ROOT).stdout
    for arguments in (
        ("generation", "plan"),
        ("baselines", "evaluate", "--agent", "stay", "--out", tmp_path / "results"),
        ("baselines", "train", "ad", "--layout", "demo_wide", "--out", tmp_path / "run"),
    ):
        done = call(*python, "-m", *arguments, cwd=ROOT)
        assert done.returncode == 1
        assert done.stderr.startswith("error: this needs "), done.stderr
        assert done.stderr.endswith(f", which is not installed: pip install '{NAME}[generation]'\n"), done.stderr


def test_the_installed_size_is_limited(installed, capsys):
    (site,) = installed.parent.glob("lib/python*/site-packages")
    files = (path for path in site.rglob("*") if path.is_file())
    # Python adds bytecode when a test imports the package: which of it is there depends on the tests that ran before.
    sizes = {path: path.stat().st_size for path in files if path.suffix != ".pyc"}
    own = sum(size for path, size in sizes.items() if path.relative_to(site).parts[0].startswith(PACKAGE))
    with capsys.disabled():
        print(f"\n{NAME}: {own:,} bytes installed, {sum(sizes.values()):,} with its dependencies ({site.parent.name})")
    release = sum(size for path, size in sizes.items() if path.is_relative_to(site / PACKAGE / "mini"))
    assert own - release <= CODE_BYTES
    assert 0 < release <= RELEASE_BYTES
    assert sum(sizes.values()) <= ENVIRONMENT_BYTES
