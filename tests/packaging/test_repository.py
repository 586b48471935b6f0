"""Test files that services and tools read: workflows, issue forms, hooks, constraints and the citation."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version

import check_jsonschema
import pre_commit.main
import pytest
import yaml
from click.testing import CliRunner
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.helpers.paths import ROOT

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = [ROOT / ".github" / "ISSUE_TEMPLATE" / name for name in ("bug.yml", "proposal.yml")]
SCHEMAS = {
    "github-workflows": WORKFLOWS,
    "github-issue-forms": FORMS,
    "github-issue-config": [ROOT / ".github" / "ISSUE_TEMPLATE" / "config.yml"],
    "citation-file-format": [ROOT / "CITATION.cff"],
}


def requirements() -> list[Requirement]:
    """Return the requirements of the package and all extras, except requirements on the package itself."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    found = [Requirement(text) for texts in lists for text in texts]
    return [one for one in found if one.name != "icrl4aht-data"]


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_match_their_schemas(schema):
    done = CliRunner().invoke(
        check_jsonschema.main, ["--builtin-schema", f"vendor.{schema}", *map(str, SCHEMAS[schema])]
    )
    assert done.exit_code == 0, done.output


def test_workflows_run_existing_make_targets():
    """The Makefile must have all targets that workflows run, and a target for each benchmark of nightly.yml."""
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    texts = [path.read_text() for path in WORKFLOWS]
    benches = yaml.safe_load(texts[0])["jobs"]["benchmarks"]["strategy"]["matrix"]["bench"]
    called = {name for text in texts for line in re.findall(r"make ([a-z -]+)", text) for name in line.split()}
    called = called - {"bench-"} | {f"bench-{name}" for name in benches}
    assert called >= {"test-slow", "demo", "check", "docs", "bench-env"} and called <= targets


def test_pre_commit_hooks_are_valid():
    assert pre_commit.main.main(["validate-config", str(ROOT / ".pre-commit-config.yaml")]) == 0


def test_constraints_pin_versions_that_the_package_allows():
    lines = [Requirement(line) for line in (ROOT / "constraints.txt").read_text().splitlines()]
    pinned = {canonicalize_name(one.name): str(one.specifier).removeprefix("==") for one in lines}
    for one in requirements():
        name = canonicalize_name(one.name)
        if name in pinned:
            assert pinned[name] in one.specifier, one
        else:
            assert "cuda" in str(one) or name == "distrax", f"{one}: no tested version; run `make constraints`"


def test_workflow_tests_the_lowest_supported_jax():
    (jax,) = (one for one in requirements() if one.name == "jax" and not one.extras)
    lowest = str(jax.specifier).removeprefix(">=")
    assert f"jax=={lowest}.0" in (ROOT / ".github" / "workflows" / "tests.yml").read_text()


def test_citation_has_the_version_of_the_package():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version("icrl4aht-data")


def test_citation_has_the_release_date_of_the_changelog():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    heading = re.search(rf"^## {cited['version']}(?:, (\d.*))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert heading and str(cited.get("date-released")) == str(heading[1])


def test_nightly_workflow_runs_the_image_that_it_builds():
    job = yaml.safe_load((ROOT / ".github" / "workflows" / "nightly.yml").read_text())["jobs"]["image"]
    _, build, run = (step.get("run", "") for step in job["steps"])
    assert build == "docker build --tag icrl4aht-data ." and run == "docker run --rm icrl4aht-data"
    assert (ROOT / "Dockerfile").read_text().endswith('CMD ["make", "demo"]\n')


def test_repository_address_is_the_same_in_all_files():
    """README, citation and site must repeat the repository address of pyproject.toml, if pyproject.toml has one."""
    url = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"].get("Repository")
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text()).get("repository-code") == url
    assert re.findall(r"^repo_url: (.*)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE) == ([url] if url else [])
    assert url is None or url in (ROOT / "README.md").read_text()
