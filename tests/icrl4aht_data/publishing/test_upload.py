"""Test uploads: complete, resumable, and tagged only if the repository equals the release."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from huggingface_hub import DatasetCard, ModelCard, snapshot_download

from icrl4aht_data import verify_release
from icrl4aht_data.errors import OptionError, ReleaseError, UploadError
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.publishing.upload import upload_release
from icrl4aht_data.utils.text import card_file, fill_template
from tests.helpers.commands import run_cli
from tests.helpers.paths import ROOT
from tests.helpers.random_releases import random_release
from tests.servers.faults import ErrorStatus, Request, SlowAnswer
from tests.servers.hub import Hub, hub_server
from tests.servers.process import uploads

pytestmark = uploads
REPO, ADDRESS = "us/histories", "hf://datasets/us/histories"


@pytest.fixture(scope="module")
def published_release(tmp_path_factory) -> Path:
    """Return a release built for publication (read-only)."""
    root = tmp_path_factory.mktemp("upload")
    random_release(root / "source", streams=2)
    return build_release(root / "source", root / "release")


@pytest.fixture
def hub(tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        yield hub


def next_version(release: Path, target: Path) -> Path:
    """Copy a release, change its data version and remove one file."""
    shutil.copytree(release, target)
    info = target / "meta/info.json"
    info.write_text(info.read_text().replace('"data_version": "0.0.1"', '"data_version": "0.1.0"'))
    (target / "figures/layouts.png").unlink()
    write_manifest(target)
    return target


def uploaded_files(hub: Hub) -> list[str]:
    """Return the paths of the large files that were uploaded completely."""
    return [request.path for request in hub.log if request.method == "PUT" and request.status == 200]


def test_dry_run_uploads_nothing(hub, published_release):
    printed = run_cli("upload", published_release, ADDRESS, "--dry-run", "--private")
    *files, last = printed.splitlines()
    assert len(files) == len(read_manifest(published_release)) + 1
    for line in files:
        size, name = line.split()
        assert int(size.replace(",", "")) == (published_release / name).stat().st_size
    assert last.endswith(f"to the new private dataset repository {REPO}, and tag them v0.0.1")
    assert not hub.repos
    assert {request.method for request in hub.log} == {"GET"}


def test_an_upload_is_complete_and_tagged(hub, published_release, tmp_path):
    done = upload_release(published_release, ADDRESS, private=True)
    assert (done.done, done.creates, done.tag, done.deletes) == ("uploaded", True, "v0.0.1", [])
    assert hub.repo(REPO).tags == {"v0.0.1": done.commit}
    assert hub.repo(REPO).private
    there = hub.files(REPO, "v0.0.1")
    del there[".gitattributes"]
    assert there == {name: (published_release / name).read_bytes() for name in done.files}
    copy = snapshot_download(
        REPO, repo_type="dataset", revision="v0.0.1", local_dir=tmp_path / "copy", ignore_patterns=".gitattributes"
    )
    shutil.rmtree(tmp_path / "copy/.cache")
    assert verify_release(copy).ok


def test_second_upload_sends_nothing_and_other_content_is_refused(hub, published_release, tmp_path):
    first = upload_release(published_release, ADDRESS)
    hub.log.clear()
    printed = run_cli("upload", published_release, ADDRESS)
    assert f"already there, {len(first.files)} files" in printed
    assert f"tag v0.0.1 is commit {first.commit}" in printed
    assert {request.method for request in hub.log} == {"GET"}
    other = shutil.copytree(published_release, tmp_path / "other")
    (other / "LICENSE").write_text("all rights reserved")
    write_manifest(other)
    with pytest.raises(
        UploadError, match=r"us/histories: tag v0\.0\.1 exists with other content: .*another data version"
    ):
        upload_release(other, ADDRESS)
    assert hub.repo(REPO).tags == {"v0.0.1": first.commit}


def test_upload_of_a_new_version_replaces_the_old_files(hub, published_release, tmp_path):
    first = upload_release(published_release, ADDRESS)
    new = next_version(published_release, tmp_path / "new")
    with pytest.raises(UploadError, match="us/histories is a public repository; make it private"):
        upload_release(new, ADDRESS, private=True)
    looked = upload_release(new, ADDRESS, dry_run=True)
    assert looked.deletes == ["figures/layouts.png"]
    assert any("would delete  figures/layouts.png" in line for line in looked.report_lines())
    before = uploaded_files(hub)
    second = upload_release(new, ADDRESS)
    assert uploaded_files(hub) == before, "large files that were there are not sent again"
    assert hub.repo(REPO).tags == {"v0.0.1": first.commit, "v0.1.0": second.commit}
    assert "figures/layouts.png" not in hub.files(REPO)
    assert "figures/layouts.png" in hub.files(REPO, "v0.0.1")


def test_repositories_with_foreign_files_are_refused(hub, published_release, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("years")
    hub.add_repo(REPO, tmp_path / "mine")
    for dry_run in (True, False):
        with pytest.raises(UploadError, match=r"contains 1 file outside any release, such as thesis\.txt"):
            upload_release(published_release, ADDRESS, dry_run=dry_run)
    assert hub.files(REPO) == {"thesis.txt": b"years"}


def test_an_invalid_release_is_not_uploaded(hub, release_copy):
    (release_copy / "meta/info.json").unlink()
    with pytest.raises(ReleaseError, match=r"not valid: meta/info\.json: listed in the manifest, but missing"):
        upload_release(release_copy, ADDRESS)
    assert not hub.log


@pytest.mark.parametrize("address", ["us/histories", "hf://us/histories", "hf://datasets/us", f"{ADDRESS}@v1"])
def test_invalid_upload_addresses_are_refused(published_release, address):
    with pytest.raises(OptionError, match=r"expected hf://datasets/ORG/REPO"):
        upload_release(published_release, address)


@pytest.mark.slow
def test_a_killed_upload_resumes(hub, published_release):
    """Kill an upload and repeat the command: completely uploaded files are not sent again."""
    puts = 0

    def delay_after_three_uploads(request: Request) -> SlowAnswer | None:
        nonlocal puts
        puts += request.method == "PUT"
        return SlowAnswer(60) if request.method == "PUT" and puts > 3 else None

    hub.faults.add(delay_after_three_uploads)
    command = [sys.executable, "-m", "icrl4aht_data", "upload", str(published_release), ADDRESS]
    process = subprocess.Popen(command, env=hub.environment | {"PATH": ""}, cwd=ROOT)
    deadline = time.monotonic() + 60
    while (len(uploaded_files(hub)) < 3 or puts < 4) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    first = uploaded_files(hub)
    assert len(first) == 3
    assert not hub.repo(REPO).tags
    hub.faults.clear()
    second = subprocess.run(command, env=hub.environment | {"PATH": ""}, cwd=ROOT, capture_output=True, text=True)
    assert (second.returncode, second.stderr) == (0, ""), "silent where output is no terminal"
    assert ": uploaded, " in second.stdout
    again = uploaded_files(hub)[3:]
    assert again and not set(first) & set(again)
    assert set(hub.repo(REPO).tags) == {"v0.0.1"}


@pytest.mark.parametrize(
    ("path", "method", "status", "message"),
    [
        ("*/refs", "GET", 403, r"token that may write to us: `hf auth login`, or set HF_TOKEN"),
        ("*/repos/create", "POST", 401, r"token that may write to us"),
        ("*/refs", "GET", 500, r"nothing was sent: run the same command again"),
        ("*/commit/main", "POST", 500, r"files sent so far are kept: run the same command"),
        ("*/tag/*", "POST", 500, r"files sent so far are kept"),
    ],
)
def test_server_errors_are_reported_and_repeating_the_upload_succeeds(
    hub, published_release, path, method, status, message
):
    hub.faults.next(ErrorStatus(status), times=9, path=path, method=method)
    with pytest.raises(UploadError, match=rf"^us/histories at http://127\.0\.0\.1:\d+: .*{status}.*; .*{message}"):
        upload_release(published_release, ADDRESS)
    assert not hub.repos or not hub.repo(REPO).tags
    hub.faults.clear()
    assert upload_release(published_release, ADDRESS).done == "uploaded"


def test_unreachable_hub_raises_upload_error(published_release, tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        hub.close()
        for dry_run in (True, False):
            with pytest.raises(UploadError, match=r"us/histories at http://.*; nothing was sent: run the same"):
                upload_release(published_release, ADDRESS, dry_run=dry_run)


def test_repository_changed_during_the_upload_gets_no_tag(hub, published_release, tmp_path):
    """Let another user commit to the repository during the upload."""
    shutil.copytree(published_release, tmp_path / "theirs")
    (tmp_path / "theirs/LICENSE").write_text("all rights reserved")
    next(tmp_path.glob("theirs/data/*/*/*.h5")).write_bytes(b"no data")
    (tmp_path / "theirs/CITATION.cff").unlink()
    (tmp_path / "theirs/more.txt").write_text("")

    def commit_as_other_user(request: Request) -> None:
        if request.method == "GET" and request.path == f"/api/datasets/{REPO}":
            hub.add_repo(REPO, tmp_path / "theirs")

    hub.faults.add(commit_as_other_user)
    with pytest.raises(UploadError, match=r"differs from the release: more\.txt: not in the .*CITATION\.cff: missing"):
        upload_release(published_release, ADDRESS)
    assert not hub.repo(REPO).tags
    hub.faults.clear()
    with pytest.raises(UploadError, match=r"outside any release, such as more\.txt"):
        upload_release(published_release, ADDRESS)


def test_huggingface_hub_reads_the_metadata_of_cards(published_release):
    assert (
        DatasetCard.load(published_release / "README.md", ignore_metadata_errors=False).data.to_dict()["license"]
        == "mit"
    )
    names = re.findall(r"\$([a-z_]+)", card_file("baseline.md").read_text())
    assert ModelCard(fill_template("baseline.md", **dict.fromkeys(names, "name") | {"datasets": ""})).data.to_dict()
