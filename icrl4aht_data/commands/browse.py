"""Command `icrl4aht-data browse`, which writes an HTML page with histories."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from icrl4aht_data.browsing.embedding import spread_histories
from icrl4aht_data.browsing.page import (
    PAGE_HISTORIES,
    PAGE_MEGABYTES,
    PAGE_START,
    check_drawable,
    make_browser_page,
    save_browser_page,
)
from icrl4aht_data.commands.options import (
    COUNT,
    COUNT_OR_NONE,
    NewFile,
    Root,
    examples,
    filter_options,
    json_option,
    overwrite_option,
    print_result,
    quiet_option,
)
from icrl4aht_data.dataset import load_icrl4aht
from icrl4aht_data.utils.files import check_output
from icrl4aht_data.utils.progress import progress_bars
from icrl4aht_data.utils.text import counted_histories, counted_noun


@click.command(
    epilog=examples(
        "icrl4aht-data browse --layout demo_wide --source ppo --out demo_wide.html",
        "icrl4aht-data browse path/to/release --history 0 --history 7",
    )
)
@click.argument("root", required=False, type=Root())
@filter_options
@click.option(
    "--history",
    "wanted",
    type=COUNT_OR_NONE,
    multiple=True,
    metavar="ID",
    help="Only this history; repeat for more.",
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
    """Write an HTML page on which to look at histories.

    One file that needs no other and no network: choose a layout, a teammate and a history, see its learning curve, and
    watch its episodes step by step, with the ego's window and the expert's action next to the ego's. Where not all
    episodes fit, some of each history can be watched, the first and the last among them; the page says which. A release
    of observations has no states to draw.
    """
    with suppress(OSError), out.open("rb") as stream:  # a page written by this command may be replaced
        overwrite = overwrite or stream.read(len(PAGE_START)) == PAGE_START
    check_output(out, overwrite)
    matching = load_icrl4aht(root, **filters)
    check_drawable(matching)
    chosen = matching.select(list(dict.fromkeys(wanted)) or spread_histories(matching, histories))
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
