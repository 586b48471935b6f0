"""`icrl4aht-data`: thin commands; the only place where exceptions become exit codes.

Exit codes: 0 done and, for `verify`, whole; 1 an error, or a release that is not whole; 2 a misused command.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import DownloadColumn, Progress, TransferSpeedColumn
from rich.table import Table

from icrl4aht_data.benchmark import KEPT_STEPS
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.remote import is_address
from icrl4aht_data.schema import ALL_KINDS, OBSERVATIONS

if TYPE_CHECKING:
    from icrl4aht_data.verify import Report


class _Root(click.ParamType):
    """A folder, or the address of a remote release."""

    name = "folder or address"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | Path:
        return value if isinstance(value, Path) or is_address(value) else Path(value)


_root = click.argument("root", required=False, type=_Root())
_json = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")


def _filters(command: Any) -> Any:
    for name in ("teammate-kind", "teammate-family", "track", "split", "layout"):
        command = click.option(f"--{name}", multiple=True, help=f"Only this {name}; may be given again.")(command)
    return command


@contextmanager
def _bars(quiet: bool, *names: str) -> Iterator[Callable[[str, int, int], None]]:
    """Progress of several things by name, on a terminal only."""
    console = Console(stderr=True)
    with Progress(console=console, disable=quiet or not console.is_terminal, transient=True) as bars:
        tasks = {name: bars.add_task(name, total=None) for name in names}
        yield lambda what, done, total: bars.update(tasks[what], completed=done, total=total)


def _wanted(filters: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    return {name: list(values) or None for name, values in filters.items()}


def _load(root: str | Path | None, filters: dict[str, tuple[str, ...]]) -> Dataset:
    return load_icrl4aht(root, **_wanted(filters))


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="icrl4aht-data")
def cli() -> None:
    """Learning histories of the ICRL4AHT benchmark.

    ROOT is a release folder, or the address of a release: hf://datasets/<org>/<repo>[@<revision>], s3://..., https://...;
    by default the mini release that comes with the package.
    """


@cli.command("list")
@_root
@_filters
@_json
def list_(root: str | Path | None, as_json: bool, **filters: tuple[str, ...]) -> None:
    """List the tasks of a release: histories, transitions, returns at the start and at the end of learning."""
    dataset = _load(root, filters)
    tasks: dict[str, dict[str, Any]] = {}
    for entry in dataset.entries:
        row = tasks.setdefault(
            entry.task_id,
            {
                "task_id": entry.task_id,
                "layout": entry.layout,
                "track": entry.track,
                "split": entry.split,
                "teammate": f"{entry.teammate_family}/{entry.teammate_kind}",
                "histories": 0,
                "transitions": 0,
                "return_start": 0.0,
                "return_end": 0.0,
            },
        )
        row["histories"] += 1
        row["transitions"] += entry.T
        for name in ("return_start", "return_end"):
            row[name] += (getattr(entry, name) - row[name]) / row["histories"]
    if as_json:
        click.echo(json.dumps(list(tasks.values()), indent=2))
        return
    table = Table("layout", "track", "split", "teammate", "histories", "transitions", "return", "task")
    for row in tasks.values():
        returns = f"{row['return_start']:.1f} -> {row['return_end']:.1f}"
        table.add_row(
            *(row[name] for name in ("layout", "track", "split", "teammate")),
            str(row["histories"]),
            f"{row['transitions']:,}",
            returns,
            row["task_id"],
        )
    Console(width=None if sys.stdout.isatty() else 200, markup=False).print(table)


@cli.command()
@_root
@_filters
@click.option("--history", "history_id", type=int, help="Show one history instead.")
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), help="Draw the learning curves into this PNG.")
@_json
def show(
    root: str | Path | None, as_json: bool, history_id: int | None, plot: Path | None, **filters: tuple[str, ...]
) -> None:
    """Show what a release, a part of it, or one of its histories is."""
    from icrl4aht_data.release import describe

    dataset = _load(root, filters)
    if history_id is None:
        info = dataset.info
        kept_steps = info["environment"]["kept_steps"]
        facts = {
            "root": str(dataset.origin),
            **({"revision": remote.revision, "folder": str(dataset.root)} if (remote := dataset.origin.remote) else {}),
            **describe(info["kind"], info["data_version"], kept_steps, dataset.entries),
            **({"lacks": lacks} if (lacks := _lacks(dataset)) else {}),
            "cache": f"{dataset.cache.cache}: {dataset.cache.reason}",
        }
    else:
        dataset = dataset.select([history_id])
        facts = {
            **dataset[0].entry.to_json(),
            "environment": dataset.recover_environment(history_id),
        }
        if dataset.knows_tasks:
            facts["teammate"] = dataset.recover_teammate(history_id)
    if plot is not None:
        from icrl4aht_data.figures import plot_learning_curves

        plot_learning_curves(dataset, plot)
        facts["plot"] = str(plot)
    if as_json:
        click.echo(json.dumps(facts, indent=2))
        return
    if history_id is None:
        click.echo(repr(dataset))
    for name, value in facts.items():
        click.echo(f"{name}: {value if isinstance(value, str) else json.dumps(value)}")


def _lacks(dataset: Dataset) -> list[str]:
    """What a full or lite release would have, in words."""
    without = len(dataset) - int(dataset.column("has_teammate_actions").sum())
    lacks = {
        "state records: nothing can be replayed or drawn, obs='state' is refused": not dataset.has_states,
        "tasks: teammates are known by family and kind only": not dataset.knows_tasks,
        f"teammate actions of {without} histories": without > 0,
    }
    return [what for what, missing in lacks.items() if missing]


@cli.command()
@click.argument("root", required=False, type=_Root(), envvar="ICRL4AHT_REMOTE")
@_filters
@click.option("--to", type=click.Path(path_type=Path, file_okay=False), help="The folder for the release.")
@click.option("--dry-run", is_flag=True, help="Say which files would come, and how many bytes; fetch only the index.")
@click.option("-q", "--quiet", is_flag=True, help="Print problems only.")
@_json
def download(
    root: str | Path | None, to: Path | None, dry_run: bool, quiet: bool, as_json: bool, **filters: tuple[str, ...]
) -> None:
    """Download the release at the address ROOT (by default $ICRL4AHT_REMOTE), or the shards of a part of it.

    Each file is checked on arrival; a download that was cut goes on where it was. Without --to a Hub repository goes
    into the Hub's cache, another release below $ICRL4AHT_DATA_DIR; `load_icrl4aht(root=ROOT)` finds either.
    """
    from icrl4aht_data.download import fetch_planned, plan_download

    if root is None:
        raise click.UsageError("give the address of a release, or set ICRL4AHT_REMOTE")
    plan = plan_download(str(root), to=to, **_wanted(filters))
    facts = plan.to_json()
    if not dry_run:
        console = Console(stderr=True)
        columns = (*Progress.get_default_columns(), DownloadColumn(), TransferSpeedColumn())
        with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bars:
            bar = bars.add_task("download", total=plan.size)
            traffic = fetch_planned(plan, lambda size: bars.advance(bar, size))
        facts |= {"fetched_bytes": traffic.bytes, "requests": traffic.requests}
    if as_json:
        click.echo(json.dumps(facts, indent=2))
    elif not quiet:
        if dry_run:
            for name in plan.absent:
                click.echo(f"{plan.files[name]:>15,}  {name}")
        verb = "to come" if dry_run else "have come"
        here = len(plan.files) - len(plan.absent)
        click.echo(f"{plan.root}: {len(plan.absent)} files, {plan.size:,} bytes {verb}; {here} files were here")
        click.echo(f"folder: {plan.root.folder}")


@cli.command()
@_root
@_filters
@click.option("--quick", is_flag=True, help="Check names, sizes and the index alone.")
@click.option("--deep", is_flag=True, help="Also replay every step and render every observation.")
@click.option("--repair", is_flag=True, help="Fetch what is wrong or missing again, then verify once more.")
@click.option("--from", "source", metavar="ADDRESS", help="Where to repair from; by default where ROOT came from.")
@click.option("-q", "--quiet", is_flag=True, help="Print problems only.")
@_json
def verify(
    root: str | Path | None,
    quick: bool,
    deep: bool,
    repair: bool,
    source: str | None,
    quiet: bool,
    as_json: bool,
    **filters: tuple[str, ...],
) -> None:
    """Verify a release: hashes, chunk checksums, counts, ranges. Exits with 1 if anything is wrong.

    Of a remote release, what is checked comes here first, unless --quick; repairing a shard fetches only what is wrong.
    """
    from icrl4aht_data.download import repair as repair_files
    from icrl4aht_data.verify import verify_release

    if quick and (deep or repair):
        raise click.UsageError("--quick reads no contents: give --deep or --repair without it")
    wanted = _wanted(filters)
    with _bars(quiet, "fetched", "files", "histories") as advance:
        report = verify_release(root, deep=deep, quick=quick, advance=advance, **wanted)
        if repair and not report.ok:
            if root is None and source is None:
                raise OptionError("the bundled release is repaired by installing the package again")
            first = report
            outcome, traffic = repair_files(MINI if root is None else root, first.files_at_fault, source=source)
            report = verify_release(root, deep=deep, advance=advance, **wanted)
            report.repaired = [name for name, error in outcome.items() if error is None]
            report.notes += [f"{name}: not repaired: {error}" for name, error in outcome.items() if error is not None]
            report.fetched_bytes += first.fetched_bytes + traffic.bytes
            report.requests += first.requests + traffic.requests
    if as_json:
        click.echo(json.dumps(report.to_json(), indent=2))
    else:
        for name in report.repaired:
            click.echo(f"{name}: repaired")
        for finding in report.findings:
            click.echo(f"{finding.file}: {finding.problem}")
        if not quiet:
            click.echo("\n".join([f"{report.root}: {_verdict(report)}", *report.notes]))
    sys.exit(0 if report.ok else 1)


def _verdict(report: Report) -> str:
    verdict = "whole" if report.ok else f"{len(report.findings)} problems"
    if report.quick:
        return f"{verdict}; checked names, sizes and the index of {report.files} files, no contents"
    physics = " and their physics" if report.replayed else ""
    fetched = f"; fetched {report.fetched_bytes:,} bytes in {report.requests} requests" if report.requests else ""
    return (
        f"{verdict}; checked {report.files} files, {report.chunks} chunks, {report.histories} histories, "
        f"{report.transitions:,} transitions{physics}{fetched}"
    )


@cli.command()
@click.argument("source", type=_Root())
@click.argument("target", type=click.Path(path_type=Path))
@click.option("--to", "form", type=click.Choice([*ALL_KINDS, "published", "parquet"]))
@click.option(
    "--tasks", type=click.Path(path_type=Path), help="Tasks of published files; their tasks.jsonl by default."
)
@click.option(
    "--kept-steps",
    type=click.IntRange(min=1),
    default=KEPT_STEPS,
    show_default=True,
    help="Steps an episode of published files.",
)
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@_filters
def convert(
    source: str | Path,
    target: Path,
    form: str | None,
    tasks: Path | None,
    kept_steps: int,
    quiet: bool,
    **filters: tuple[str, ...],
) -> None:
    """Convert SOURCE, a release or a folder with the published code's histories.h5, into TARGET.

    full, lite and observations are releases, published is the published code's two files, parquet is the index as one
    file. Published files become lite by default, or observations where they have no state records.
    """
    from icrl4aht_data import convert as forms

    console = Console(stderr=True)
    with Progress(console=console, disable=quiet or not console.is_terminal, transient=True) as bars:
        bar = bars.add_task("histories", total=None)

        def advance(done: int, total: int) -> None:
            bars.update(bar, completed=done, total=total)

        if isinstance(source, Path) and (source / forms.HISTORIES_H5).exists():
            if (form is not None and form not in ALL_KINDS) or any(filters.values()):
                raise click.UsageError("published files convert to full, lite or observations, and whole")
            form = forms.from_published(source, target, form, tasks=tasks, kept_steps=kept_steps, advance=advance)
        elif form is None:
            raise click.UsageError("say what to make of a release: --to full, lite, observations, published or parquet")
        elif form in ALL_KINDS:
            forms.to_release(_load(source, filters), target, form, advance=advance)
        elif form == "published":
            forms.to_published(_load(source, filters), target, advance=advance)
        else:
            forms.to_parquet(_load(source, filters), target)
    lacking = ", no state records: nothing can be replayed or drawn" if form == OBSERVATIONS else ""
    click.echo(f"{target}: {form}{lacking}")


@cli.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.argument("releases", nargs=-1, required=True, type=_Root(), metavar="RELEASE...")
@click.option("--data-version", help="SemVer of the combination; that of the releases by default, if they agree.")
@click.option("-q", "--quiet", is_flag=True, help="Print problems only.")
def combine(out: Path, releases: tuple[str | Path, ...], data_version: str | None, quiet: bool) -> None:
    """Combine releases of one kind, no two with a task in common, into the release OUT."""
    from icrl4aht_data.combine import combine_releases
    from icrl4aht_data.info import read_info
    from icrl4aht_data.statistics import print_statistics

    combine_releases(out, releases, data_version)
    if not quiet:
        click.echo(f"release: {out}")
        print_statistics(read_info(out), Console())


@cli.group()
def release() -> None:
    """Make releases ready for other people."""


@release.command()
@click.argument("source", nargs=-1, type=click.Path(path_type=Path), metavar="[SOURCE]")
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--link", is_flag=True, help="Hard links instead of copies: no space, but both change if one is changed.")
@click.option("-q", "--quiet", is_flag=True, help="Print problems only.")
@_json
def build(source: tuple[Path, ...], out: Path, link: bool, quiet: bool, as_json: bool) -> None:
    """Build the release OUT for publication: all of SOURCE, a release, and what people and tools look for beside it.

    That is README.md with a dataset card, figures, the index as Parquet for viewers, croissant.json, LICENSE,
    CITATION.cff, cards of the learned teammates and a new manifest. SOURCE is verified first; by default it is the
    bundled mini release.
    """
    from icrl4aht_data.manifest import read_manifest
    from icrl4aht_data.publish import build_release

    if len(source) > 1:
        raise click.UsageError("give one SOURCE at most, then OUT")
    with _bars(quiet, "files", "histories", "copying") as advance:
        build_release(source[0] if source else None, out, link=link, advance=advance)
    files = list(read_manifest(out))
    size = sum((out / name).stat().st_size for name in files)
    if as_json:
        click.echo(json.dumps({"release": str(out), "files": files, "bytes": size}, indent=2))
    elif not quiet:
        click.echo(f"release: {out}, {len(files)} files, {size:,} bytes; its card is {out / 'README.md'}")


@cli.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("address", metavar="hf://datasets/ORG/REPO")
@click.option("--private", is_flag=True, help="Make a new repository private; refuse one that is public.")
@click.option("--dry-run", is_flag=True, help="Say what would be done; change nothing.")
@click.option("-q", "--quiet", is_flag=True, help="Print problems only.")
@_json
def upload(folder: Path, address: str, private: bool, dry_run: bool, quiet: bool, as_json: bool) -> None:
    """Upload the release FOLDER to a dataset repository of the Hugging Face Hub, and tag it with the data version.

    The release is verified first, the repository made if there is none. An upload that was cut off goes on with the
    same command. Afterwards what the repository holds is compared with the manifest; only then it is tagged. A tag
    never moves: other data need another version. `hf auth login` gives the token.
    """
    from icrl4aht_data.upload import upload_release

    with _bars(quiet, "files", "histories") as advance:
        done = upload_release(
            folder, address, private=private, dry_run=dry_run, show=not quiet and sys.stderr.isatty(), advance=advance
        )
    if as_json:
        click.echo(json.dumps(done.to_json(), indent=2))
    elif not quiet:
        click.echo("\n".join(done.in_words()))


def run(command: click.Command) -> None:
    """Run a command line; what is wrong with the input becomes one line and exit code 1."""
    try:
        command()
    except BrokenPipeError:
        sys.exit(1)
    except (Icrl4ahtError, OSError) as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(1)


def main() -> None:
    """Entry point."""
    run(cli)
