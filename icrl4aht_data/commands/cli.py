"""`icrl4aht-data`: thin commands."""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.table import Table

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    SETTINGS,
    Folder,
    NewFile,
    Root,
    Sections,
    bars,
    counted,
    examples,
    filter_options,
    json_option,
    quiet_option,
    run,
    version_option,
)
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.schema import ALL_KINDS, OBSERVATIONS
from icrl4aht_data.plotting import PICTURES

if TYPE_CHECKING:
    from icrl4aht_data.checking.report import Report

_root = click.argument("root", required=False, type=Root())


def _wanted(filters: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    return {name: list(values) or None for name, values in filters.items()}


def _load(root: str | Path | None, filters: dict[str, tuple[str, ...]]) -> Dataset:
    return load_icrl4aht(root, **_wanted(filters))


_SECTIONS = {
    "Look": ("list", "show", "verify", "doctor"),
    "Bring and change": ("download", "convert", "combine"),
    "Publish": ("release", "upload"),
}

_EXAMPLES = examples(
    "icrl4aht-data list",
    "icrl4aht-data show --layout coord_simple --plot curves.png",
    "icrl4aht-data verify path/to/release --deep",
    "icrl4aht-data download hf://datasets/you/icrl4aht --layout coord_simple",
)

_EPILOG = f"""{_EXAMPLES}

Exit codes: 0 done, 1 a failure or something found wrong, 2 a misused command. The folders and environment variables
in use: `icrl4aht-data doctor`.

\b
Completion, in bash (for zsh and fish: zsh_source, fish_source):
  eval "$(_ICRL4AHT_DATA_COMPLETE=bash_source icrl4aht-data)"
"""


@click.group(cls=Sections, sections=_SECTIONS, context_settings=SETTINGS, epilog=_EPILOG)
@version_option
def cli() -> None:
    """Read, check, fetch and publish the learning histories of the ICRL4AHT benchmark.

    ROOT is a release: its folder, or its address hf://datasets/<org>/<repo>[@<revision>], https://... or s3://...
    Without ROOT, the mini release that comes with the package is meant.
    """


@cli.command("list")
@_root
@filter_options
@json_option
def list_(root: str | Path | None, as_json: bool, **filters: tuple[str, ...]) -> None:
    """List the tasks of a release.

    A line a task: layout, teammate, histories, transitions, and the mean return of an episode at the start and at the
    end of learning.
    """
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
@filter_options
@click.option("--history", "history_id", type=COUNT_OR_NONE, metavar="ID", help="Show this one history instead.")
@click.option("--plot", type=NewFile(*PICTURES), metavar="FILE", help="Also draw learning curves: .png, .svg or .pdf.")
@json_option
def show(
    root: str | Path | None, as_json: bool, history_id: int | None, plot: Path | None, **filters: tuple[str, ...]
) -> None:
    """Show what a release, a part of it or a history is.

    Prints kind, versions, counts and layouts; of one history all that the index says. Writes nothing but --plot.
    """
    from icrl4aht_data.format.info import describe

    dataset = _load(root, filters)
    if history_id is None:
        info = dataset.info
        facts = {
            "root": str(dataset.origin),
            **({"revision": remote.revision, "folder": str(dataset.root)} if (remote := dataset.origin.remote) else {}),
            **describe(info.kind, info.data_version, info.environment.kept_steps, dataset.entries).to_json(),
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
        from icrl4aht_data.plotting import plot_learning_curves

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


@cli.command(
    epilog=examples(
        "icrl4aht-data download hf://datasets/you/icrl4aht --layout coord_simple --dry-run",
        "icrl4aht-data download https://example.org/icrl4aht --to icrl4aht",
    )
)
@click.argument("root", required=False, type=Root(remote=True), envvar="ICRL4AHT_REMOTE", metavar="[ADDRESS]")
@filter_options
@click.option("--to", type=Folder(), metavar="FOLDER", help="Write the release here.")
@click.option("--dry-run", is_flag=True, help="Fetch the index alone; print which files would come, and their bytes.")
@quiet_option
@json_option
def download(
    root: str | Path | None, to: Path | None, dry_run: bool, quiet: bool, as_json: bool, **filters: tuple[str, ...]
) -> None:
    """Download a release, or a part of it.

    ADDRESS is hf://datasets/<org>/<repo>[@<revision>], https://... or s3://...; by default $ICRL4AHT_REMOTE. Each file
    is checked on arrival; the same command goes on where a download was cut. Without --to a Hub repository goes into
    the Hub's cache, another release below $ICRL4AHT_DATA_DIR (~/.local/share/icrl4aht); load_icrl4aht(root=ADDRESS)
    finds either.
    """
    from icrl4aht_data.remote.download import fetch_planned, plan_download

    if root is None:
        raise click.UsageError("give the ADDRESS of a release, or set ICRL4AHT_REMOTE")
    plan = plan_download(str(root), to=to, **_wanted(filters))
    facts = plan.to_json()
    if not dry_run:
        with bars(quiet, of_bytes=True) as show:
            traffic = fetch_planned(plan, counted(show, "download", plan.size))
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
@filter_options
@click.option("--quick", is_flag=True, help="Check names, sizes and the index alone.")
@click.option("--deep", is_flag=True, help="Also replay every step and render every observation.")
@click.option("--repair", is_flag=True, help="Fetch what is wrong or missing again, then verify once more.")
@click.option("--from", "source", metavar="ADDRESS", help="Repair from here.", show_default="where ROOT came from")
@quiet_option
@json_option
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
    """Verify a release: every byte, count and range.

    Prints a line for each thing that is wrong, and exits with 1 if there is one. Nothing is written, unless --repair. A
    remote release is fetched first, unless --quick; repairing a shard fetches only what is wrong in it.
    """
    from icrl4aht_data.checking.verify import verify_release
    from icrl4aht_data.remote.download import repair as repair_files

    if quick and (deep or repair):
        raise click.UsageError("--quick reads no contents: give --deep or --repair without it")
    if source and not repair:
        raise click.UsageError("--from says where to repair from: give --repair with it")
    wanted = _wanted(filters)
    with bars(quiet) as advance:
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
            click.echo(finding.problem if finding.file == "." else f"{finding.file}: {finding.problem}")
        if not quiet:
            click.echo("\n".join([f"{report.root}: {_verdict(report)}", *report.notes]))
    sys.exit(0 if report.ok else 1)


def _verdict(report: Report) -> str:
    number = len(report.findings)
    verdict = "whole" if report.ok else f"{number} problem{'s' * (number > 1)}"
    if report.quick:
        return f"{verdict}; checked names, sizes and the index of {report.files} files, no contents"
    physics = " and their physics" if report.replayed else ""
    fetched = f"; fetched {report.fetched_bytes:,} bytes in {report.requests} requests" if report.requests else ""
    return (
        f"{verdict}; checked {report.files} files, {report.chunks} chunks, {report.histories} histories, "
        f"{report.transitions:,} transitions{physics}{fetched}"
    )


@cli.command(
    epilog=examples(
        "icrl4aht-data convert path/to/release full --to full --layout coord_simple",
        "icrl4aht-data convert path/to/published lite",
    )
)
@click.argument("source", type=Root())
@click.argument("target", type=click.Path(path_type=Path), metavar="OUT")
@click.option("--to", "form", type=click.Choice([*ALL_KINDS, "published", "parquet"]), help="What to make.")
@click.option(
    "--tasks",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="Of published files: their tasks.",
    show_default="tasks.jsonl beside them",
)
@click.option("--kept-steps", type=COUNT, default=KEPT_STEPS, help="Of published files: steps of an episode.")
@filter_options
@quiet_option
def convert(
    source: str | Path,
    target: Path,
    form: str | None,
    tasks: Path | None,
    kept_steps: int,
    quiet: bool,
    **filters: tuple[str, ...],
) -> None:
    """Convert a release, or published files, into OUT.

    SOURCE is a release, or a folder with the published code's histories.h5 and histories_index.jsonl. OUT becomes a
    release folder (full, lite, observations), a folder with the published code's two files (published), or a file with
    the index as a table (parquet). Published files become lite by default, or observations where they have no state
    records.
    """
    from icrl4aht_data.writing.convert import to_release
    from icrl4aht_data.writing.parquet import to_parquet
    from icrl4aht_data.writing.published import HISTORIES_H5, from_published, to_published

    with bars(quiet) as show:
        advance = partial(show, "histories")
        advance(0, None)  # how many there are is known only later
        if isinstance(source, Path) and (source / HISTORIES_H5).exists():
            if (form is not None and form not in ALL_KINDS) or any(filters.values()):
                raise click.UsageError("published files convert to full, lite or observations, and whole")
            form = from_published(source, target, form, tasks=tasks, kept_steps=kept_steps, advance=advance)
        else:
            dataset = _load(source, filters)
            if form is None:
                raise click.UsageError(
                    "say what to make of a release: --to full, lite, observations, published, parquet"
                )
            if tasks or kept_steps != KEPT_STEPS:
                raise click.UsageError(f"{source} is a release: --tasks and --kept-steps are for published files")
            if form in ALL_KINDS:
                to_release(dataset, target, form, advance=advance)
            elif form == "published":
                to_published(dataset, target, advance=advance)
            else:
                to_parquet(dataset, target)
    lacking = ", no state records: nothing can be replayed or drawn" if form == OBSERVATIONS else ""
    if not quiet:
        click.echo(f"{target}: {form}{lacking}")


@cli.command(epilog=examples("icrl4aht-data combine both path/to/release path/to/another --data-version 1.0.0"))
@click.argument("out", type=Folder())
@click.argument("releases", nargs=-1, required=True, type=Root(), metavar="ROOT...")
@click.option(
    "--data-version",
    metavar="SEMVER",
    help="Of the combination, such as 1.0.0.",
    show_default="that of the releases, if they agree",
)
@quiet_option
def combine(out: Path, releases: tuple[str | Path, ...], data_version: str | None, quiet: bool) -> None:
    """Combine releases into one, in the folder OUT.

    They are of one kind, and no two have a task in common. A release that is at OUT is replaced. The card is made anew;
    those of the releases are kept in meta/source_card.md.
    """
    from icrl4aht_data.format.info import read_info
    from icrl4aht_data.writing.combine import combine_releases
    from icrl4aht_data.writing.statistics import print_statistics

    combine_releases(out, releases, data_version)
    if not quiet:
        click.echo(f"release: {out}")
        print_statistics(read_info(out), Console())


@cli.group()
def release() -> None:
    """Make a release ready for other people."""


@release.command()
@click.argument("source", nargs=-1, type=Folder(), metavar="[SOURCE]")
@click.argument("out", type=Folder())
@click.option("--link", is_flag=True, help="Hard links instead of copies: no space, but both change if one is changed.")
@quiet_option
@json_option
def build(source: tuple[Path, ...], out: Path, link: bool, quiet: bool, as_json: bool) -> None:
    """Build a release for publication in the folder OUT.

    It holds all of SOURCE, a release folder (by default the bundled mini release), which is verified first, and what
    people and tools look for beside it: README.md with a dataset card, figures, the index as Parquet for viewers,
    croissant.json, LICENSE, CITATION.cff, cards of the learned teammates and a new manifest. Needs the extras plot and
    hf.
    """
    from icrl4aht_data.format.manifest import read_manifest
    from icrl4aht_data.publishing.build import build_release

    if len(source) > 1:
        raise click.UsageError("give one SOURCE at most, then OUT")
    with bars(quiet) as advance:
        build_release(source[0] if source else None, out, link=link, advance=advance)
    files = list(read_manifest(out))
    size = sum((out / name).stat().st_size for name in files)
    if as_json:
        click.echo(json.dumps({"release": str(out), "files": files, "bytes": size}, indent=2))
    elif not quiet:
        click.echo(f"release: {out}, {len(files)} files, {size:,} bytes; its card is {out / 'README.md'}")


@cli.command(epilog=examples("icrl4aht-data upload build/release hf://datasets/you/icrl4aht --dry-run"))
@click.argument("folder", type=Folder())
@click.argument("address", type=Root(remote=True))
@click.option("--private", is_flag=True, help="Make a new repository private; refuse one that is public.")
@click.option("--dry-run", is_flag=True, help="Print what would be done; change nothing.")
@quiet_option
@json_option
def upload(folder: Path, address: str, private: bool, dry_run: bool, quiet: bool, as_json: bool) -> None:
    """Upload a release to the Hugging Face Hub, and tag it.

    FOLDER is a release, as `release build` makes it; ADDRESS is hf://datasets/<org>/<repo>. The release is verified
    first, the repository made if there is none. The same command goes on where an upload was cut. Afterwards what the
    repository holds is compared with the manifest; only then it is tagged with the data version. A tag never moves:
    other data need another version. `hf auth login` gives the token.
    """
    from icrl4aht_data.publishing.upload import upload_release

    with bars(quiet) as advance:
        done = upload_release(
            folder, address, private=private, dry_run=dry_run, show=not quiet and sys.stderr.isatty(), advance=advance
        )
    if as_json:
        click.echo(json.dumps(done.to_json(), indent=2))
    elif not quiet:
        click.echo("\n".join(done.in_words()))


@cli.command()
@json_option
def doctor(as_json: bool) -> None:
    """Look at this installation, and say what is wrong.

    Prints versions, optional packages and which extra brings them, devices, the folders in use (where they are set,
    what they hold, whether they can be written), environment variables, and whether the bundled release is whole.
    Nothing is written or asked of the network. Exits with 1 and a next step for each problem if there is one.
    """
    from icrl4aht_data.commands.doctor import diagnose, in_words

    found = diagnose()
    click.echo(json.dumps(found.to_json(), indent=2) if as_json else "\n".join(in_words(found)))
    sys.exit(0 if found.ok else 1)


def main() -> None:
    """Entry point."""
    run(cli)
