"""The hub that tests talk to, against huggingface_hub itself."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import huggingface_hub
import numpy as np
import pytest
from huggingface_hub import DatasetCard, HfApi, constants, hf_hub_download, hffs, snapshot_download
from huggingface_hub.errors import (
    BadRequestError,
    EntryNotFoundError,
    HfHubHTTPError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from tests.servers.common import Cut, Etag, Fault, Flip, Hub, Status, hub_server, uploads
from tests.servers.test_servers import DATA, FAULTS, check_fault, get

CARD = b"---\nlicense: mit\ntags:\n- games\nsize_categories: [1K<n<10K]\n---\n# Games\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Files of a dataset. Read only."""
    root = tmp_path_factory.mktemp("dataset") / "games"
    (root / "shards").mkdir(parents=True)
    (root / "shards" / "a b.h5").write_bytes(DATA)
    (root / "empty").write_bytes(b"")
    (root / "data.txt").write_bytes(DATA)
    (root / "README.md").write_bytes(CARD)
    return root


@pytest.fixture
def hub(tmp_path, folder) -> Iterator[Hub]:
    """A hub with one dataset, tagged v1."""
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/games", folder, tag="v1")
        yield hub


def read(folder: Path | str) -> dict[str, bytes]:
    """The files of a folder, without the client's notes in a hidden one."""
    paths = {path.relative_to(folder).as_posix(): path for path in Path(folder).rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in paths.items() if not name.startswith(".cache/")}


def asked(hub: Hub, method: str, part: str) -> list[str]:
    """Paths of the requests of a method that have a part in them."""
    return [entry.path for entry in hub.log if entry.method == method and part in entry.path]


def test_information(hub):
    api = HfApi()
    info = api.dataset_info("org/games", files_metadata=True)
    siblings = {sibling.rfilename: sibling for sibling in info.siblings or []}
    assert sorted(siblings) == ["README.md", "data.txt", "empty", "shards/a b.h5"]
    large = siblings["shards/a b.h5"]
    assert large.lfs is not None
    assert (large.size, large.lfs.size, siblings["data.txt"].lfs) == (len(DATA), len(DATA), None)
    assert info.sha == api.dataset_info("org/games", revision="v1").sha == hub.repo("org/games").tags["v1"]
    assert info.tags == ["license:mit", "size_categories:1K<n<10K", "games"]
    references = api.list_repo_refs("org/games", repo_type="dataset")
    assert [(ref.name, ref.ref, ref.target_commit) for ref in references.tags] == [("v1", "refs/tags/v1", info.sha)]
    assert api.whoami()["name"] == "tester"


def test_trees(hub):
    hub.page = 2
    api = HfApi()
    assert len(api.list_repo_files("org/games", repo_type="dataset")) == 4
    listed = list(api.list_repo_tree("org/games", repo_type="dataset", expand=True))
    assert [entry.path for entry in listed] == ["README.md", "data.txt", "empty", "shards"]
    assert listed[0].last_commit is not None
    below = list(api.list_repo_tree("org/games", "shards", repo_type="dataset"))
    found = api.get_paths_info("org/games", ["shards/a b.h5", "shards", "none"], repo_type="dataset")
    assert [entry.path for entry in below] == ["shards/a b.h5"]
    assert [entry.path for entry in found] == ["shards/a b.h5", "shards"]
    assert found[0] == below[0]


def test_a_tag_is_downloaded_whatever_came_after(hub, folder, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "README.md").write_bytes(b"new")
    latest = hub.add_repo("org/games", tmp_path / "other")
    first = hub.repo("org/games").tags["v1"]
    for revision, content in (("v1", read(folder)), (first, read(folder)), (latest, {"README.md": b"new"})):
        assert hub.files("org/games", revision) == content
        assert read(snapshot_download("org/games", repo_type="dataset", revision=revision)) == content
    assert snapshot_download("org/games", repo_type="dataset").startswith(str(tmp_path))


def test_large_files_come_from_the_cdn_without_the_token(hub):
    hf_hub_download("org/games", "shards/a b.h5", repo_type="dataset", revision="v1")
    redirected, served = (entry for entry in hub.log if "a b.h5" in entry.path)
    assert (redirected.method, redirected.status, redirected.headers["Authorization"]) == (
        "HEAD",
        302,
        "Bearer hf_test",
    )
    assert (served.method, served.status, served.headers["Authorization"]) == ("GET", 200, None)
    assert served.path.startswith("/cdn/")


def test_fsspec_reads_the_hub(hub):
    filesystem = fsspec.filesystem("hf")
    root = "datasets/org/games@v1"
    assert sorted(filesystem.find(root)) == [
        f"{root}/{name}" for name in ("README.md", "data.txt", "empty", "shards/a b.h5")
    ]
    for name in ("data.txt", "shards/a b.h5"):
        assert filesystem.cat_file(f"{root}/{name}") == DATA
        assert filesystem.cat_file(f"{root}/{name}", start=1000, end=1500) == DATA[1000:1500]
        with filesystem.open(f"{root}/{name}", block_size=4096) as file:
            file.seek(150_000)
            assert file.read(100) == DATA[150_000:150_100]
    ranges = [(entry.start, entry.stop) for entry in hub.log if entry.status == 206]
    assert ranges == 2 * [(1000, 200_000), (150_000, 154_196)]  # `cat_file` reads a block ahead of what it was asked
    assert hffs.exists(f"{root}/empty")


@uploads
def test_a_folder_goes_up_and_comes_back(hub, folder, tmp_path):
    source = tmp_path / "source"
    (source / "shards").mkdir(parents=True)
    (source / "README.md").write_bytes(CARD)
    (source / "shards" / "b.h5").write_bytes(DATA[::-1])
    (source / "large.txt").write_bytes(np.random.default_rng(1).bytes(11 << 20))
    api = HfApi()
    api.create_repo("org/new", repo_type="dataset", private=True)
    api.create_repo("org/new", repo_type="dataset", exist_ok=True)
    done = api.upload_folder(folder_path=source, repo_id="org/new", repo_type="dataset")
    api.create_tag("org/new", tag="v1", repo_type="dataset")
    assert len(asked(hub, "PUT", "/lfs/")) == 2
    assert done.oid == hub.repo("org/new").tags["v1"]
    again = api.upload_folder(folder_path=source, repo_id="org/new", repo_type="dataset")
    assert again.oid == done.oid

    api.delete_file("README.md", "org/new", repo_type="dataset")
    assert sorted(hub.files("org/new")) == [".gitattributes", "large.txt", "shards/b.h5"]
    back = read(snapshot_download("org/new", repo_type="dataset", revision="v1", local_dir=tmp_path / "back"))
    assert back.pop(".gitattributes")
    assert back == read(source)
    titles = [commit.title for commit in api.list_repo_commits("org/new", repo_type="dataset")]
    assert titles == ["Delete README.md with huggingface_hub", "Upload folder using huggingface_hub", "initial commit"]
    with pytest.raises(RepositoryNotFoundError):
        api.dataset_info("org/new", token=False)
    with pytest.raises(HfHubHTTPError, match="A commit has happened since"):
        api.upload_file(
            path_or_fileobj=b"x", path_in_repo="x", repo_id="org/new", repo_type="dataset", parent_commit=done.oid
        )
    with pytest.raises(HfHubHTTPError, match="Reference already exists"):
        api.create_tag("org/new", tag="v1", repo_type="dataset")


@uploads
def test_models_branches_and_tags(hub, tmp_path):
    api = HfApi()
    api.create_repo("agent")
    api.upload_file(path_or_fileobj=DATA, path_in_repo="weights.safetensors", repo_id="tester/agent")
    api.create_branch("tester/agent", branch="next/one")
    api.upload_file(path_or_fileobj=b"{}", path_in_repo="a.json", repo_id="tester/agent", revision="next/one")
    assert sorted(hub.files("tester/agent", kind="model")) == [".gitattributes", "weights.safetensors"]
    path = hf_hub_download("tester/agent", "a.json", revision="next/one")
    assert Path(path).read_bytes() == b"{}"
    api.create_tag("tester/agent", tag="v1", revision="next/one")
    api.delete_tag("tester/agent", tag="v1")
    api.delete_branch("tester/agent", branch="next/one")
    assert api.model_info("tester/agent").sha == hub.repo("tester/agent", "model").branches["main"]
    api.delete_repo("tester/agent")
    with pytest.raises(RepositoryNotFoundError):
        api.model_info("tester/agent")


def test_what_is_not_there(hub):
    api = HfApi()
    with pytest.raises(RepositoryNotFoundError):
        api.dataset_info("org/none")
    with pytest.raises(RevisionNotFoundError):
        snapshot_download("org/games", repo_type="dataset", revision="v2")
    with pytest.raises(EntryNotFoundError):
        hf_hub_download("org/games", "none", repo_type="dataset")
    with pytest.raises(FileNotFoundError):
        fsspec.filesystem("hf").info("datasets/org/games/none")
    with pytest.raises(HfHubHTTPError, match="Invalid user token"):
        api.whoami(token="hf_other")
    with pytest.raises(HfHubHTTPError, match="401"):
        api.create_repo("org/other", token="hf_other")


def test_an_upload_must_be_what_it_was_announced_as(hub):
    name = "0" * 64
    assert get(hub.cdn, f"/lfs/{name}", "PUT", b"else")[0].status == 400
    assert get(hub.cdn, f"/cdn/{name}/a.h5")[0].status == 404


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ("license: mitt", '"license" must be one of'),
        ("license: [mit", "YAML"),
        ("- mit", "must be an object"),
        ("license: mit\nlicense: mit", "duplicated mapping key"),
        ("pretty_name: 3", '"pretty_name" must be a string'),
        ("tags: games", '"tags" must be an array'),
        ("language: [no]", '"language\\[0\\]" must be a string'),
        ("size_categories: [many]", '"size_categories" must be one of'),
        ("configs: [{data_files: a.parquet}]", "config_name"),
        ("configs: [{config_name: a, data_files: [{split: train}]}]", "data_files"),
        ("configs: [{config_name: a}, {config_name: a}]", "twice"),
    ],
)
def test_cards_that_are_refused(hub, metadata, message):
    content = f"---\n{metadata}\n---\n# Games\n"
    with pytest.raises(ValueError, match=message):
        validate(content)


def validate(content: str) -> None:
    """The client's check before an upload."""
    HfApi()._validate_yaml(content, repo_type="dataset")


def test_a_card_that_is_refused_is_not_committed(hub, monkeypatch):
    with pytest.raises(ValueError, match='"license" must be one of'):
        DatasetCard("---\nlicense: mitt\n---\n").validate()
    monkeypatch.setattr(HfApi, "_validate_yaml", lambda *arguments, **options: None)
    with pytest.raises(BadRequestError, match="Invalid metadata in README"):
        HfApi().upload_file(
            path_or_fileobj=b"---\nlicense: mitt\n---\n",
            path_in_repo="README.md",
            repo_id="org/games",
            repo_type="dataset",
        )
    assert hub.files("org/games")["README.md"] == CARD


def test_cards_that_pass(hub):
    configs = "configs:\n- config_name: a\n  data_files:\n  - split: train\n    path: [x/*.parquet, y.parquet]\n"
    for content in (CARD.decode(), f"---\n{configs}---\n", CARD.decode().replace("\n", "\r\n")):
        DatasetCard(content).validate()
        validate(content)
    with pytest.warns(UserWarning, match="empty or missing yaml metadata"):
        validate("# Games\n")


@FAULTS
def test_faults_of_files(hub, fault: Fault, status, body):
    response, _ = get(hub.endpoint, "/datasets/org/games/resolve/v1/shards/a%20b.h5")
    large = response.headers["Location"].removeprefix(hub.cdn)
    for url, path in ((hub.endpoint, "/datasets/org/games/resolve/v1/data.txt"), (hub.cdn, large)):
        hub.faults.next(fault, path=path.split("?")[0].replace("%20", " "))
        check_fault(url, path, fault, status, body)


def test_the_client_meets_faults(hub, monkeypatch):
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    hub.faults.next(Status(503), path="/api/*/tree/*")
    hub.faults.next(Cut(1000), path="*/a b.h5")
    hub.faults.next(Flip(-1), path="*/data.txt")
    found = read(snapshot_download("org/games", repo_type="dataset", revision="v1"))
    assert found["shards/a b.h5"] == DATA
    assert (found["data.txt"][:-1], found["data.txt"][-1]) == (DATA[:-1], DATA[-1] ^ 255)
    assert [entry.sent for entry in hub.log if entry.path.startswith("/cdn/")] == [1000, len(DATA)]

    hub.faults.next(Etag("0" * 64), path="*/resolve/*/a b.h5", method="HEAD")
    metadata = huggingface_hub.get_hf_file_metadata(
        huggingface_hub.hf_hub_url("org/games", "shards/a b.h5", repo_type="dataset", revision="v1")
    )
    assert metadata.etag == "0" * 64


def test_another_process(hub, folder):
    code = (
        "import huggingface_hub as hub; api = hub.HfApi();"
        "api.create_repo('org/two', repo_type='dataset');"
        "path = hub.snapshot_download('org/games', repo_type='dataset', revision='v1');"
        "api.upload_folder(folder_path=path, repo_id='org/two', repo_type='dataset')"
    )
    environment = {**os.environ, **hub.environment}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, timeout=60)
    found = hub.files("org/two")
    del found[".gitattributes"]
    assert found == read(folder)


def test_settings_are_put_back(tmp_path):
    names = ("ENDPOINT", "HF_HUB_CACHE", "HF_HOME", "HF_HUB_DISABLE_XET", "HUGGINGFACE_CO_URL_TEMPLATE")
    before = [getattr(constants, name) for name in names], hffs.endpoint, dict(os.environ)
    with hub_server(tmp_path / "a") as outer:
        with hub_server(tmp_path / "b") as inner:
            assert HfApi().endpoint == hffs.endpoint == fsspec.filesystem("hf").endpoint == inner.endpoint
            assert os.environ["HF_ENDPOINT"] == inner.endpoint
        assert HfApi().endpoint == huggingface_hub.hf_api.api.endpoint == outer.endpoint
    assert ([getattr(constants, name) for name in names], hffs.endpoint, dict(os.environ)) == before
