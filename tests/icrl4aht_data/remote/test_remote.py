"""Remote releases: opening, streaming, partial and resumed downloads, verifying and repairing; over HTTP, S3 and the
Hub's protocol, all served on loopback."""

from __future__ import annotations

import json
import pickle
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.histories import write_many
from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import OfflineError, OptionError, RemoteError, RootNotFoundError, UnknownNameError
from icrl4aht_data.format.chunks import chunk_table_path
from icrl4aht_data.remote.download import fetch_planned, plan_download, repair
from icrl4aht_data.remote.store import RetryPolicy, Store
from tests.helpers.batches import assert_equal
from tests.robustness import bench_remote
from tests.servers.common import Cut, Flip, http_server, hub_server
from tests.servers.process import hub_environment, hub_settings

QUICK = RetryPolicy(attempts=2, first_wait=0.01)


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch) -> Path:
    """The data folder, empty at first."""
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Path:
    """A release of two layouts with some histories of full length each. Read only."""
    return write_many(tmp_path_factory.mktemp("many") / "release", bench_remote.LAYOUTS, 24)


@pytest.fixture(params=["http", pytest.param("s3", marks=pytest.mark.slow), "hub"])
def served(request, lite) -> Iterator[str]:
    """Address of `lite` on a server of each kind in turn."""
    with bench_remote.remote(request.param, lite[0]) as url:
        yield url


def contents(folder: Path) -> dict[str, bytes]:
    """File name -> content of all files below a folder."""
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("first", "logged"), [(0.001, []), (2.0, ["2 s", "4 s"])])
def test_a_long_wait_is_logged(first, logged, monkeypatch, caplog):
    monkeypatch.setattr("tenacity.nap.time.sleep", lambda seconds: None)
    store = Store("https://nowhere.test/release", RetryPolicy(attempts=3, first_wait=first))

    def refuse():
        raise ConnectionError("no such host")

    with pytest.raises(RemoteError, match=r"no such host \(3 attempts\)"):
        store.with_retries("meta/info.json", refuse)
    start = "https://nowhere.test/release/meta/info.json: ConnectionError: no such host; trying again in "
    assert caplog.messages == [start + wait for wait in logged]


def test_a_remote_release_reads_as_its_local_twin(served, lite):
    local, remote = load_icrl4aht(lite[0]), load_icrl4aht(served)
    assert [h.entry for h in remote] == [h.entry for h in local]
    assert remote.info == local.info and remote.recover_teammate(3) == local.recover_teammate(3)
    for ours, theirs in zip(remote, local, strict=True):
        assert np.array_equal(ours.obs[3:17], theirs.obs[3:17])
        assert np.array_equal(ours.expert_actions[:], theirs.expert_actions[:])
    assert not list((remote.root / "data").rglob("*.h5")), "no shard was downloaded"


@pytest.mark.parametrize("cache", ["auto", "ram", "mmap", "stream"])
def test_batches_are_the_same_with_every_cache(lite, cache):
    for layout in bench_remote.LAYOUTS:
        with http_server(lite[0]) as server:
            local = load_icrl4aht(lite[0], layout=layout)
            remote = load_icrl4aht(server.url, layout=layout, cache=cache)
            if cache == "auto":
                assert remote.cache.cache == "stream" and "are not downloaded" in remote.cache.reason
            options = {"batch_size": 16, "seed": 3, "teammate_actions": True}
            for i in range(2):
                assert_equal(remote.ad(length=30, **options)[i], local.ad(length=30, **options)[i])
                for order in ("contiguous", "random"):
                    shown = {"context": 25, "order": order, **options}
                    assert_equal(remote.dpt(**shown)[i], local.dpt(**shown)[i])


@pytest.mark.parametrize("kind", ["http", "s3", "hub"])
def test_requests_and_bytes(many, kind, folders):
    """The benchmark's measurements on fewer histories, where only the share of streamed bytes says little."""
    with bench_remote.remote(kind, many) as url:
        facts = bench_remote.measure(url, many, windows=8, length=500)
    assert facts["equal"] and facts["complete"] and facts["repaired"]
    assert facts["requests_a_window"] <= 1.5 and facts["repaired_share"] <= 0.01
    assert facts["bytes"] < 8 * 6000, "a window's chunks and little else"


def test_a_batch_requests_exactly_the_ranges_it_counts(many):
    with http_server(many) as server:
        dataset = load_icrl4aht(server.url, layout="demo_wide", obs="state")
        _ = dataset.storage
        seen, before = len(server.log), dataset.traffic
        sampler = dataset.ad(batch_size=8, length=500, seed=1)
        sampler[0]
        traffic = dataset.traffic - before
        assert traffic.requests == len(server.log) - seen > 0
        assert traffic.bytes == sum(request.sent for request in server.log[seen:])
        sampler[0]
        assert dataset.traffic - before == traffic, "downloaded chunks are not requested again"
        again = load_icrl4aht(server.url, layout="demo_wide", obs="state")
        _ = again.storage
        before = again.traffic
        again.ad(batch_size=8, length=500, seed=1)[0]
        assert (again.traffic - before).requests == 0, "nor by another process: they are on disk"


def test_datasets_can_be_pickled(lite):
    with http_server(lite[0]) as server:
        remote = pickle.loads(pickle.dumps(load_icrl4aht(server.url, layout="demo_wide")))
        local = load_icrl4aht(lite[0], layout="demo_wide")
        assert_equal(remote.ad(batch_size=4, length=30)[0], local.ad(batch_size=4, length=30)[0])


def test_a_part_is_downloaded(served, lite, folders):
    plan = plan_download(served, layout="demo_wide")
    assert sum(name.endswith(".h5") for name in plan.files) == 1 and 0 < plan.size == sum(
        plan.files[n] for n in plan.absent
    )
    fetch_planned(plan)
    again = plan_download(served, layout="demo_wide")
    assert again.absent == [] and again.files == plan.files
    dataset = load_icrl4aht(served, layout="demo_wide")
    assert dataset.cache.cache == "ram"
    assert_equal(
        dataset.ad(batch_size=4, length=30)[0],
        load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=4, length=30)[0],
    )
    report = verify_release(served, level="deep", layout="demo_wide")
    assert report.ok and report.notes == ["1 of 2 shards were not selected"], report.findings
    assert report.requests == 0
    report = verify_release(served, level="deep")
    assert report.ok and report.notes == [] and report.histories == 12


def test_a_download_into_a_given_folder(served, lite, tmp_path):
    target = tmp_path / "mine"
    fetch_planned(plan_download(served, to=target, layout="coord_simple"))
    assert verify_release(target).ok, "it has the part that was requested"
    fetch_planned(plan_download(served, to=target, layout="demo_wide"))
    assert verify_release(target, level="deep").notes == []
    assert contents(target) == contents(lite[0])
    shard = load_icrl4aht(target).shards[0]
    (target / shard).unlink()
    assert verify_release(target).files_at_fault == {shard}


def test_versions_are_not_mixed_in_a_folder(lite, full, tmp_path):
    with http_server(lite[0]) as server:
        fetch_planned(plan_download(server.url, to=tmp_path / "mine"))
    with http_server(full[0]) as server, pytest.raises(OptionError, match="holds another release or version than http"):
        plan_download(server.url, to=tmp_path / "mine")


def test_a_new_version_at_the_same_address(lite, full, tmp_path):
    shutil.copytree(lite[0], tmp_path / "served")
    with http_server(tmp_path / "served") as server:
        first = load_icrl4aht(server.url)
        shutil.rmtree(tmp_path / "served")
        shutil.copytree(full[0], tmp_path / "served")
        second = load_icrl4aht(server.url)
        assert (first.info.kind, second.info.kind) == ("lite", "full")
        assert first.root != second.root
        with pytest.raises(RemoteError, match="damaged or not of this version"):
            first[0].actions[:]


def test_a_cut_download_resumes_at_the_missing_chunks(many, folders):
    name = load_icrl4aht(many, layout="demo_wide").shards[0]
    with http_server(many) as server:
        server.faults.next(Cut(1000), times=10**6, path=f"*{Path(name).name}", method="GET")
        with pytest.raises(RemoteError, match="what has arrived is kept: repeat the command to resume"):
            fetch_planned(plan_download(server.url, retry=QUICK))
        server.faults.clear()
        size = (many / name).stat().st_size
        root = load_icrl4aht(server.url).origin
        assert root.remote is not None
        part = root.remote.part(name)
        with (many / name).open("rb") as stream:
            part.put(0, stream.read(size // 2))  # the first half has arrived
        seen = len(server.log)
        fetch_planned(plan_download(server.url, layout="demo_wide", retry=QUICK))
        again = sum(r.sent for r in server.log[seen:] if r.path.endswith(name) and r.method == "GET")
        assert size // 2 <= again <= size // 2 + 4096
        assert verify_release(server.url, layout="demo_wide").ok


def test_the_stream_cache_is_bounded(many, monkeypatch, folders):
    monkeypatch.setenv("ICRL4AHT_CACHE_BYTES", "300000")
    with http_server(many) as server:
        for layout in bench_remote.LAYOUTS:
            dataset = load_icrl4aht(server.url, layout=layout, obs="state")
            for i in range(6):
                expected = load_icrl4aht(many, layout=layout, obs="state").ad(batch_size=16, length=500)[i]
                assert_equal(dataset.ad(batch_size=16, length=500)[i], expected)
                kept = sum(path.stat().st_blocks * 512 for path in folders.glob("*/*.partial/**/*") if path.is_file())
                assert kept <= 300_000 + 100_000


@pytest.mark.parametrize("variable", ["HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE"])
def test_offline(served, lite, monkeypatch, variable):
    monkeypatch.setenv(variable, "1")
    with pytest.raises(OfflineError, match="go online to fetch it"):
        load_icrl4aht(served)
    monkeypatch.delenv(variable)
    fetch_planned(plan_download(served, layout="demo_wide"))
    monkeypatch.setenv(variable, "1")
    remote = load_icrl4aht(served, layout="demo_wide")
    assert_equal(
        remote.ad(batch_size=4, length=30)[0], load_icrl4aht(lite[0], layout="demo_wide").ad(batch_size=4, length=30)[0]
    )
    missing = load_icrl4aht(served, layout="coord_simple", cache="ram")
    with pytest.raises(
        OfflineError, match=r"offline, and not downloaded: data/teammate/coord_simple/train-00000-of-00001\.h5"
    ):
        missing.ad(batch_size=4, length=30)[0]


def test_the_revision_is_pinned_and_shown(lite, full, tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        first = hub.add_repo("org/name", lite[0], tag="v0.0.1")
        hub.add_repo("org/name", full[0])
        tagged, newest = (load_icrl4aht(f"hf://datasets/org/name{at}") for at in ("@v0.0.1", ""))
        assert (tagged.info.kind, newest.info.kind) == ("lite", "full")
        assert str(tagged.origin) == f"hf://datasets/org/name@{first}"
        shown = json.loads(CliRunner().invoke(cli, ["show", "hf://datasets/org/name@v0.0.1", "--json"]).output)
        assert (shown["revision"], shown["data_version"]) == (first, tagged.info.data_version)


@pytest.mark.parametrize("what", ["shard", "two shards", "missing", "index", "table and shard", "manifest", "all"])
def test_repair(lite, tmp_path, what):
    root = tmp_path / "copy"
    shards = load_icrl4aht(lite[0]).shards
    with http_server(lite[0]) as server:
        fetch_planned(plan_download(server.url, to=root))
        intact = contents(root)

        def flip_bit(path: Path) -> None:
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 8
            path.write_bytes(data)

        if what in ("shard", "two shards", "table and shard", "all"):
            flip_bit(root / shards[0])
        if what == "two shards":
            flip_bit(root / shards[1])
        if what in ("missing", "all"):
            (root / shards[1]).unlink()
        if what in ("index", "all"):
            flip_bit(root / "meta" / "histories.jsonl")
            flip_bit(root / "meta" / "info.json")
        if what == "table and shard":
            flip_bit(chunk_table_path(root, shards[0]))
        if what in ("manifest", "all"):
            (root / "MANIFEST.sha256").write_text("nonsense\n")
        result = CliRunner().invoke(cli, ["verify", str(root), "--json"])
        assert result.exit_code == 1 and not json.loads(result.output)["ok"]
        result = CliRunner().invoke(cli, ["verify", str(root), "--repair", "--json"])
        assert result.exit_code == 0, result.output
        report = json.loads(result.output)
        assert report["ok"] and report["repaired"]
        assert contents(root) == intact


def test_a_file_that_another_thread_downloads_meanwhile_is_no_changed_one(lite, tmp_path, monkeypatch):
    name = load_icrl4aht(lite[0]).shards[0]
    with http_server(lite[0]) as server:
        remote = plan_download(server.url, to=tmp_path / "copy").root.remote
        assert remote is not None
        is_here = type(remote).is_here

        def downloaded_meanwhile(self, wanted):
            found = is_here(self, wanted)
            self.path(wanted).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(lite[0] / wanted, self.path(wanted))
            return found

        monkeypatch.setattr(type(remote), "is_here", downloaded_meanwhile)
        remote.fetch([name])
    assert not remote.owned
    assert not remote.replaced
    assert (tmp_path / "copy" / name).read_bytes() == (lite[0] / name).read_bytes()


def test_repair_needs_the_right_source(lite, full, tmp_path, monkeypatch):
    root = tmp_path / "copy"
    shutil.copytree(lite[0], root)
    monkeypatch.delenv("ICRL4AHT_REMOTE", raising=False)
    with pytest.raises(OptionError, match="needs the address of a complete copy"):
        repair(root, ["README.md"])
    before = contents(root)
    with http_server(full[0]) as server, pytest.raises(OptionError, match="it has another release or version"):
        repair(root, ["README.md"], source=server.url)
    assert contents(root) == before
    (root / "README.md").write_text("?")
    with http_server(lite[0]) as server:
        monkeypatch.setenv("ICRL4AHT_REMOTE", server.url)
        assert repair(root, ["README.md"])[0] == {"README.md": None}
    assert contents(root) == before


def test_a_damaged_source_changes_nothing(lite, tmp_path):
    for name in ("here", "there"):
        shutil.copytree(lite[0], tmp_path / name)
    shard = load_icrl4aht(lite[0]).shards[0]
    for name in ("here", "there"):
        data = bytearray((lite[0] / shard).read_bytes())
        data[len(data) // 2] ^= 8
        (tmp_path / name / shard).write_bytes(data)
    before = contents(tmp_path / "here")
    with http_server(tmp_path / "there") as server:
        outcome, _ = repair(tmp_path / "here", [shard], source=server.url, retry=QUICK)
    assert "expected crc32" in str(outcome[shard])
    assert contents(tmp_path / "here") == before


def test_quick_verification_compares_sizes_only(served, lite, tmp_path):
    report = verify_release(served, level="quick")
    assert report.ok and report.chunks == 0
    root = tmp_path / "copy"
    shutil.copytree(lite[0], root)
    shard = load_icrl4aht(root).shards[0]
    (root / shard).write_bytes((root / shard).read_bytes()[:-1])
    assert [finding.problem[:8] for finding in verify_release(root, level="quick").findings] == ["expected"]


def test_download_command(lite, tmp_path, monkeypatch):
    run = CliRunner()
    with http_server(lite[0]) as server:
        result = run.invoke(cli, ["download", server.url, "--layout", "demo_wide", "--dry-run", "--json"])
        plan = json.loads(result.output)
        assert plan["bytes"] == sum(plan["files"][name] for name in plan["absent"]) > 0
        result = run.invoke(cli, ["download", server.url, "--dry-run"])
        assert "MANIFEST" not in result.output and "meta/chunks/teammate/demo_wide" in result.output
        monkeypatch.setenv("ICRL4AHT_REMOTE", server.url)
        result = run.invoke(cli, ["download", "--to", str(tmp_path / "mine")])
        assert result.exit_code == 0 and "bytes downloaded" in result.output
        assert contents(lite[0]).items() <= contents(tmp_path / "mine").items()
        result = run.invoke(cli, ["convert", server.url, "--out", str(tmp_path / "full"), "--to", "full"])
        assert result.exit_code == 0 and verify_release(tmp_path / "full", level="deep").ok
    monkeypatch.delenv("ICRL4AHT_REMOTE")
    assert run.invoke(cli, ["download"]).exit_code == 2


@pytest.mark.parametrize(
    ("url", "error", "message"),
    [
        ("{server}/nowhere", RootNotFoundError, r"no release there, expected MANIFEST\.sha256"),
        ("hf://org/name", OptionError, "expected hf://datasets/<org>/<repo>"),
        ("gopher://old/times", OptionError, "not an address that fsspec opens"),
        ("http://127.0.0.1:9/release", RemoteError, r"MANIFEST\.sha256: .*2 attempts"),
    ],
)
def test_bad_addresses(lite, url, error, message, monkeypatch):
    monkeypatch.setattr("icrl4aht_data.remote.store.RetryPolicy", lambda: QUICK)
    with http_server(lite[0]) as server, pytest.raises(error, match=message):
        load_icrl4aht(url.format(server=server.url))


def test_bad_filters_and_folders(served):
    with pytest.raises(UnknownNameError, match="unknown layout 'demo_wid'; valid: coord_simple"):
        plan_download(served, layout="demo_wid")
    with pytest.raises(OptionError, match="expected an address"):
        plan_download("folder")


def test_repositories_without_a_release(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "README.md").write_text("hello")
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/empty", tmp_path / "empty")
        for name in ("org/empty", "org/absent", "org/empty@v9"):
            with pytest.raises(RootNotFoundError, match=r"no release there, expected MANIFEST\.sha256"):
                load_icrl4aht(f"hf://datasets/{name}")


@pytest.mark.parametrize("silent", [False, True], ids=["refuses connections", "accepts and never answers"])
def test_an_unreachable_hub_is_reported_at_once(tmp_path, monkeypatch, silent):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_ETAG_TIMEOUT", 1)  # 10 s by default
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        if silent:
            server.listen()
        endpoint = f"http://127.0.0.1:{server.getsockname()[1]}"
        began = time.monotonic()
        with hub_settings(hub_environment(endpoint, tmp_path, "token")), pytest.raises(RemoteError) as caught:
            load_icrl4aht("hf://datasets/org/name")
    assert time.monotonic() - began < 10
    assert "hf://datasets/org/name/MANIFEST.sha256: " in str(caught.value) and not caught.value.missing


def test_a_hub_that_has_become_unreachable_serves_its_cache(lite, tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        url = "hf://datasets/org/name"
        fetch_planned(plan_download(url, layout="demo_wide"))
        hub.close()
        assert load_icrl4aht(url, layout="demo_wide")[0].actions[:].shape
        with pytest.raises(RemoteError, match=r"/data/teammate/coord_simple/train-00000-of-00001\.h5.*: ConnectError"):
            fetch_planned(plan_download(url, layout="coord_simple"))


@pytest.mark.parametrize("to", [None, "mine"])
def test_a_download_from_the_hub(lite, tmp_path, to):
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        plan = plan_download("hf://datasets/org/name", to=to and tmp_path / to)
        advanced: list[int] = []
        traffic = fetch_planned(plan, advanced.append)
        assert sum(advanced) == plan.size == traffic.bytes
        assert traffic.requests == len(plan.absent)
        assert contents(lite[0]).items() <= contents(plan.root.folder).items()
        load_icrl4aht("hf://datasets/org/name", cache="stream")[0].actions[:]
        sent = {(request.path.startswith("/cdn/"), request.headers["Authorization"]) for request in hub.log}
        assert sent == {(False, f"Bearer {hub.token}"), (True, None)}, "the token must not leave the Hub"


@pytest.mark.parametrize("to", [None, "mine"])
def test_a_file_that_the_hub_serves_damaged_is_refused(lite, tmp_path, to):
    url, folder = "hf://datasets/org/name", to and tmp_path / to
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        hub.faults.next(Flip(100), path="/cdn/*.h5")  # has the right length: only the manifest's hash finds it
        with pytest.raises(RemoteError, match=r"\.h5: expected sha256 \w+, found \w+: fetch it again"):
            fetch_planned(plan_download(url, to=folder))
        plan = plan_download(url, to=folder)
        assert [Path(name).suffix for name in plan.absent] == [".h5"], "the other files are kept"
        fetch_planned(plan)
        shutil.rmtree(tmp_path / "hub" / "home")
        hub.faults.next(Flip(50), path="*/MANIFEST.sha256")
        with pytest.raises(RemoteError, match=r"MANIFEST\.sha256: arrived damaged"):
            load_icrl4aht(url)
        assert verify_release(url).ok
