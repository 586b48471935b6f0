"""Commands of `icrl4aht-data` that read, fetch, convert and publish releases."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.browsing.page import (
    BROWSER_PAGE_START,
    PAGE_HISTORIES,
    PAGE_MEGABYTES,
    make_browser_page,
    save_browser_page,
    varied_history_ids,
)
from icrl4aht_data.checking.report import verdict_in_words
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.commands.doctor import diagnose, report_lines
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    Folder,
    NewFile,
    ReleaseArgument,
    examples,
    filter_options,
    is_terminal,
    json_option,
    overwrite_option,
    print_result,
    quiet_option,
)
from icrl4aht_data.commands.summaries import (
    fact_lines,
    layout_table,
    summarize_selection,
    summarize_tasks,
    tab_separated,
    task_table,
)
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.fetch import fetch_planned, plan_download
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import ALL_KINDS, OBSERVATIONS
from icrl4aht_data.plotting import PICTURES, plot_learning_curves
from icrl4aht_data.publishing.build import build_release
from icrl4aht_data.publishing.upload import upload_release
from icrl4aht_data.utils.files import check_output, starts_with
from icrl4aht_data.utils.progress import bar_updater, progress_bars
from icrl4aht_data.utils.text import counted_histories, counted_noun
from icrl4aht_data.writing.combine import combine_releases
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.minari import to_minari
from icrl4aht_data.writing.parquet import to_parquet
from icrl4aht_data.writing.published import from_published, to_published
from icrl4aht_data.writing.release_folder import HISTORIES_H5

_FORMS = (*ALL_KINDS, "published", "parquet", "minari")

_root = click.argument("root", required=False, type=ReleaseArgument())


@click.command("list")
@_root
@filter_options
@json_option
def list_(root: str | Path | None, as_json: bool, **filters: Any) -> None:
    """List the tasks of a release.

    Prints the layout, split, teammate, source, number of histories and number of steps of each task, and the mean
    return of an episode at the start and at the end of learning. Also prints the kinds of labels, with the return of
    the expert policy if it was measured, and shortened ids of the task and its histories. If the output is not a
    terminal, prints one line of tab-separated values for each task, with complete ids, below a line with the names of
    the values.
    """
    tasks = summarize_tasks(load_icrl4aht(root, **filters).entries)
    if as_json or not is_terminal():
        print_result(tasks, tab_separated([tasks[0], *(task.values() for task in tasks)]), as_json)
        return
    Console(markup=False).print(task_table(tasks))


@click.command()
@_root
@filter_options
@click.option(
    "--history", "history_id", type=COUNT_OR_NONE, metavar="ID", help="Show only this history; `list` prints the ids."
)
@click.option(
    "--plot",
    type=NewFile(*PICTURES),
    metavar="FILE",
    help="Also draw returns by episode and source: .png, .svg or .pdf.",
)
@overwrite_option
@json_option
def show(
    root: str | Path | None,
    as_json: bool,
    history_id: int | None,
    plot: Path | None,
    overwrite: bool,
    **filters: Any,
) -> None:
    """Show a release, a part of it or one history.

    Prints a summary, a table of the layouts with totals, and versions, counts, splits, sources and labels; for one
    history, all fields of its index entry. If the output is not a terminal, prints one line for each value:
    the name, a tab and the value. Only --plot writes a file.
    """
    if overwrite and plot is None:
        raise click.UsageError("--overwrite replaces an existing picture: also give --plot FILE")
    if plot is not None:
        check_output(plot, overwrite)
    if isinstance(root, Path) and str(root).isdecimal() and not root.exists():
        raise click.UsageError(f"{root}: no such folder; if this is a history's id, use --history {root}")
    dataset = load_icrl4aht(root, **filters)
    if history_id is None:
        facts = summarize_selection(dataset)
    else:
        dataset = dataset.select([history_id])
        facts = dataset[0].entry.to_json() | {"environment": dataset.environment_parameters(history_id)}
        if dataset.has_tasks:
            facts["teammate"] = dataset.recover_teammate(history_id)
    if plot is not None:
        plot_learning_curves(dataset, plot)
        facts["plot"] = str(plot)
    if as_json or not is_terminal():
        print_result(facts, tab_separated(facts.items()), as_json)
        return
    console = Console(markup=False, highlight=False)
    if history_id is None:
        console.print(facts.pop("summary"), "", layout_table(dataset), "", sep="\n")
        del facts["layouts"]  # already shown in the table
    else:
        console.print(repr(dataset[0]), "", sep="\n")
    console.print(*fact_lines(facts), sep="\n")


@click.command(
    epilog=examples(
        "icrl4aht-data browse --layout demo_wide --source ppo --out demo_wide.html",
        "icrl4aht-data browse path/to/release --history 0 --history 7",
    )
)
@_root
@filter_options
@click.option(
    "--history",
    "wanted",
    type=COUNT_OR_NONE,
    multiple=True,
    metavar="ID",
    help="Only this history; repeat the option for more.",
)
@click.option("--histories", type=COUNT, default=PAGE_HISTORIES, help="Maximum number of histories on the page.")
@click.option("--megabytes", type=COUNT, default=PAGE_MEGABYTES, help="Maximum size of the page in MB.")
@click.option(
    "--out",
    type=NewFile(".html", ".htm"),
    metavar="FILE",
    default="browse.html",
    help="File to write.",
)
@overwrite_option
@quiet_option
@json_option
def browse(
    root: str | Path | None,
    wanted: tuple[int, ...],
    histories: int,
    megabytes: int,
    out: Path,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
    **filters: Any,
) -> None:
    """Write an HTML page that shows and replays histories.

    The page is one file that needs no network. Choose a layout, a teammate and a history, see the learning curve, and
    watch episodes step by step, with the cells that the ego observes, the ego's action and the expert's action. If not
    all episodes fit, the page has some episodes of each history, including the first and the last, and says which. A
    release of observations cannot be shown, since it has no states to draw.
    """
    # A page that `browse` wrote is replaced even without --overwrite.
    check_output(out, overwrite or (out.is_file() and starts_with(out, BROWSER_PAGE_START)))
    matching = load_icrl4aht(root, **filters)
    chosen = matching.select(list(dict.fromkeys(wanted)) or varied_history_ids(matching, histories))
    with progress_bars(quiet) as show:
        page = make_browser_page(
            chosen, megabytes=megabytes, advance=lambda done, total: show("histories", done, total)
        )
    save_browser_page(page, out)
    facts: dict[str, Any] = {"page": str(out), "histories": page.histories}
    facts |= {"episodes": page.episodes, "shown_episodes": page.shown_episodes, "bytes": len(page.html)}
    shown = "all" if page.shown_episodes == page.episodes else f"{page.shown_episodes:,} of"
    text = f"{out}: {page.histories} of {counted_histories(len(matching))}, {shown} "
    text += f"{counted_noun(page.episodes, 'episode')} to watch, {len(page.html):,} bytes"
    print_result(facts, text, as_json, quiet)


@click.command(
    epilog=examples(
        "icrl4aht-data download hf://datasets/you/icrl4aht --layout coord_simple --dry-run",
        "icrl4aht-data download https://example.org/icrl4aht --to icrl4aht",
    )
)
@click.argument(
    "root", required=False, type=ReleaseArgument(remote=True), envvar="ICRL4AHT_REMOTE", metavar="[ADDRESS]"
)
@filter_options
@click.option("--to", type=Folder(), metavar="FOLDER", help="Write the release here.")
@click.option("--dry-run", is_flag=True, help="Fetch only the index; print the files to download and their sizes.")
@quiet_option
@json_option
def download(
    root: str | Path | None, to: Path | None, dry_run: bool, quiet: bool, as_json: bool, **filters: Any
) -> None:
    """Download a release, or a part of it.

    ADDRESS is hf://datasets/<org>/<repo>[@<revision>], https://... or s3://...; by default $ICRL4AHT_REMOTE. Each
    downloaded file is checked; the same command resumes an interrupted download, and replaces files that have changed.
    Without --to, a Hub repository is stored in the Hub's cache, another release in $ICRL4AHT_DATA_DIR
    (~/.local/share/icrl4aht); load_icrl4aht(root=ADDRESS) finds both. FOLDER must be new, empty, or have files of this
    release only.
    """
    if root is None:
        raise click.UsageError("give the ADDRESS of a release, or set ICRL4AHT_REMOTE")
    with progress_bars(quiet, of_bytes=True) as show:
        plan = plan_download(str(root), to=to, advance=show, **filters)
        facts = plan.to_json()
        if not dry_run:
            fetch_planned(plan, bar_updater(show, "download", plan.size))
    absent = sorted((*plan.absent, *plan.changed))
    lines = [f"{plan.files[name]:>15,}  {name}" for name in absent if dry_run]
    lines += [f"{name}: had changed{'' if dry_run else ', was fetched again'}" for name in plan.changed]
    verb = "to download" if dry_run else "downloaded"
    here = f"{counted_noun(len(plan.files) - len(absent), 'file')} present already, with the right hashes"
    lines.append(f"{plan.root}: {counted_noun(len(absent), 'file')}, {plan.size:,} bytes {verb}; {here}")
    lines.append(f"folder: {plan.root.folder}")
    chosen = [f"--{name.replace('_', '-')} {value}" for name, values in filters.items() for value in values or ()]
    if chosen:
        lines.append(f"partial release: `icrl4aht-data verify {plan.root.folder} {' '.join(chosen)}` checks it")
    print_result(facts, "\n".join(lines), as_json, quiet)


@click.command()
@_root
@filter_options
@click.option("--quick", is_flag=True, help="Check only names, sizes and the index.")
@click.option("--deep", is_flag=True, help="Also replay every step and render every observation.")
@quiet_option
@json_option
def verify(
    root: str | Path | None,
    quick: bool,
    deep: bool,
    quiet: bool,
    as_json: bool,
    **filters: Any,
) -> None:
    """Verify a release: every byte, count and range.

    Prints one line per problem, and exits with 1 if a problem is found. A remote release is downloaded first, except
    with --quick. `download` replaces damaged files. For a partially downloaded release, give the filters of the
    download.
    """
    if quick and deep:
        raise click.UsageError("--quick and --deep exclude each other: give only one of them")
    level = "quick" if quick else "deep" if deep else "full"
    with progress_bars(quiet) as advance:
        report = verify_release(root, level=level, advance=advance, **filters)
    lines = [one.problem if one.file == "." else f"{one.file}: {one.problem}" for one in report.findings]
    lines += [f"{report.root}: {verdict_in_words(report)}", *report.notes] if not quiet else []
    print_result(report.to_json(), "\n".join(lines), as_json, quiet=not lines)
    sys.exit(0 if report.ok else 1)


@click.command(
    epilog=examples(
        "icrl4aht-data convert path/to/release --to full --layout coord_simple --out full",
        "icrl4aht-data convert path/to/published --out lite",
        "icrl4aht-data convert path/to/release --layout demo_wide --to minari --out demo_wide-v0",
    )
)
@click.argument("root", required=False, type=ReleaseArgument(), metavar="[SOURCE]")
@click.option(
    "--out",
    "target",
    type=click.Path(path_type=Path),
    metavar="PATH",
    required=True,
    help="Write the release, the folder of published files, the Minari dataset or the Parquet file here.",
)
@overwrite_option
@click.option("--to", "form", type=click.Choice(_FORMS), help="Format to convert to.")
@click.option("--kept-steps", type=COUNT, default=KEPT_STEPS, help="Steps of an episode in published files.")
@filter_options
@quiet_option
def convert(
    root: str | Path | None,
    target: Path,
    overwrite: bool,
    form: str | None,
    kept_steps: int,
    quiet: bool,
    **filters: Any,
) -> None:
    """Convert a release or published files.

    SOURCE is a release, by default the bundled mini release, or a folder with the published code's histories.h5 and
    histories_index.jsonl, and with tasks.jsonl if the tasks are known. Writes a release folder (full, lite,
    observations), a folder with the published code's two files (published), a Minari dataset (minari) in a folder with
    a name such as demo_wide-v0, which minari.load_dataset opens, or a Parquet file with the index (parquet). By
    default, published files are converted to lite, or to observations if they have no state records.
    """
    with progress_bars(quiet) as show:
        advance = partial(show, "histories")
        advance(0, None)  # the total is unknown before the first history
        if isinstance(root, Path) and (root / HISTORIES_H5).exists():
            if (form is not None and form not in ALL_KINDS) or any(filters.values()):
                raise click.UsageError(
                    "published files can only be converted to full, lite or observations, and without filters"
                )
            form = from_published(
                root,
                target,
                form,
                kept_steps=kept_steps,
                overwrite=overwrite,
                advance=advance,
            )
        else:
            dataset = load_icrl4aht(root, **filters)
            if form is None:
                raise click.UsageError(f"give the format to convert to: --to {', '.join(_FORMS)}")
            if kept_steps != KEPT_STEPS:
                raise click.UsageError(f"{dataset.root} is a release: --kept-steps is for published files")
            if form in ALL_KINDS:
                to_release(dataset, target, form, overwrite=overwrite, advance=advance)
            elif form == "parquet":
                to_parquet(dataset, target, overwrite=overwrite)
            else:
                write = to_published if form == "published" else to_minari
                write(dataset, target, overwrite=overwrite, advance=advance)
    limit = ", no state records: nothing can be replayed or drawn" if form == OBSERVATIONS else ""
    if not quiet:
        click.echo(f"{target}: {form}{limit}")


@click.command(epilog=examples("icrl4aht-data combine path/to/release path/to/another --data-version 1.0.0 --out both"))
@click.argument("releases", nargs=-1, required=True, type=ReleaseArgument(), metavar="ROOT...")
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the combined release here.")
@overwrite_option
@click.option(
    "--data-version",
    metavar="SEMVER",
    help="Data version of the combined release, such as 1.0.0.",
    show_default="the version of the releases, if they agree",
)
@quiet_option
def combine(
    releases: tuple[str | Path, ...], out: Path, overwrite: bool, data_version: str | None, quiet: bool
) -> None:
    """Combine releases into one.

    The releases must be of the same kind and have no common task. The combined release gets a new card.
    """
    combine_releases(out, releases, data_version, overwrite=overwrite)
    if not quiet:
        click.echo(f"release: {out}")


@click.command(epilog=examples("icrl4aht-data release build path/to/release --out build/release"))
@click.argument("source", required=False, type=Folder())
@click.option("--out", type=Folder(), metavar="FOLDER", required=True, help="Write the release here.")
@overwrite_option
@quiet_option
@json_option
def build(source: Path | None, out: Path, overwrite: bool, quiet: bool, as_json: bool) -> None:
    """Build a release for publication.

    Verifies SOURCE, a release folder (by default the bundled mini release), copies its data, and adds README.md with a
    dataset card, figures, Parquet files for viewers, croissant.json, LICENSE, CITATION.cff and a new manifest. Needs
    the extras plot and hf.
    """
    with progress_bars(quiet) as advance:
        build_release(source, out, overwrite=overwrite, advance=advance)
    files = list(read_manifest(out))
    size = sum((out / name).stat().st_size for name in files)
    text = f"release: {out}, {len(files)} files, {size:,} bytes; its card is {out / 'README.md'}"
    print_result({"release": str(out), "files": files, "bytes": size}, text, as_json, quiet)


@click.command(epilog=examples("icrl4aht-data upload build/release hf://datasets/you/icrl4aht --dry-run"))
@click.argument("folder", type=Folder())
@click.argument("address", type=ReleaseArgument(remote=True))
@click.option("--private", is_flag=True, help="Make a new repository private; refuse one that is public.")
@click.option("--dry-run", is_flag=True, help="Print the plan; change nothing.")
@quiet_option
@json_option
def upload(folder: Path, address: str, private: bool, dry_run: bool, quiet: bool, as_json: bool) -> None:
    """Upload a release to the Hugging Face Hub, and tag it.

    FOLDER is a release made by `release build`; ADDRESS is hf://datasets/<org>/<repo>. The release is verified first; a
    missing repository is created. The same command resumes an interrupted upload. After the upload, the repository's
    files and manifest are compared with the release, and the commit is tagged with the data version. A tag never moves,
    so changed data need a new version. `hf auth login` stores the token.
    """
    if quiet or not sys.stderr.isatty():
        import_module("huggingface_hub.utils").disable_progress_bars()
    with progress_bars(quiet) as advance:
        done = upload_release(folder, address, private=private, dry_run=dry_run, advance=advance)
    print_result(done.to_json(), "\n".join(done.report_lines()), as_json, quiet)


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Examine this installation, and report problems.

    Prints versions, optional packages and the extras that install them, names that other packages register, devices,
    the folders in use and their free space, network settings, and the state of the bundled release. Leaves no files
    behind, and does not use the network. Prints a next step for each problem, and exits with 1 if any is found.
    """
    found = diagnose()
    print_result(found, "\n".join(report_lines(found)), as_json)
    sys.exit(0 if found["ok"] else 1)
