"""Preparation of a release for publication: card, figures, Parquet files and Croissant added to its data."""

from __future__ import annotations

import datetime
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from icrl4aht_data.benchmark.facts import ALGORITHMS
from icrl4aht_data.benchmark.reference_returns import read_headroom
from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import Icrl4ahtError, IndexFormatError, OptionError, ReleaseError, unknown
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.schema import (
    CARD_TABLES,
    MANIFEST,
    PARQUET_EPISODES,
    PARQUET_INDEX,
    RELEASE_CARD,
    SOURCE_CARD,
    TEAMMATES,
)
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.plotting import plot_headroom, plot_layout_curves, plot_layouts
from icrl4aht_data.publishing.croissant import CROISSANT, croissant
from icrl4aht_data.utils.files import files_below, parse_json, read_text, write_json
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.templates import card_file, fill_template
from icrl4aht_data.writing.card import (
    CURVES_FIGURE,
    HEADROOM_FIGURE,
    HEADROOM_PROTOCOL,
    LAYOUTS_FIGURE,
    evaluated_on,
    write_card,
)
from icrl4aht_data.writing.parquet import to_parquet, write_episodes
from icrl4aht_data.writing.release_folder import as_path, atomic_folder, check_target

_COPIED_TEXTS = ("LICENSE", "CITATION.cff")
_POLICY = "policy.json"
_LIBRARIES = {"matplotlib": "plot", "PIL": "plot", "pyarrow": "hf", "mlcroissant": "hf"}
"""Module required for building -> extra that installs it."""


def build_release(
    source: str | Path | None,
    target: str | Path,
    *,
    link: bool = False,
    overwrite: bool = False,
    published: datetime.date | None = None,
    advance: NamedProgress = lambda what, done, total: None,
) -> Path:
    """Copy a release and add the files of a published release.

    Args:
        source: a release folder; the bundled mini release by default.
        target: the folder to write, which appears when it is complete.
        link: hard-link the files of `source` instead of copying them, which saves space; later changes of a file then
            affect both releases.
        overwrite: replace a release at `target`.
        published: date of publication for Croissant; today by default.
        advance: called with the name of a stage, the number of items done, and their total.

    Raises:
        OptionError: if `target` may not be written, see `release_folder.check_target`, or a library is not installed.
        ReleaseError: if `source` is not valid; names the first problems.
    """
    source, target = as_path(MINI if source is None else source).resolve(), as_path(target)
    check_target(target, overwrite, [source])
    missing = [name for name in _LIBRARIES if find_spec(name) is None]
    if missing:
        raise OptionError(f"building a release needs {', '.join(missing)}: {install_command('plot', 'hf')}")
    check_valid(source, advance)
    kept = {name: digest for name, digest in read_manifest(source).items() if not _is_made_here(name)}
    with atomic_folder(target, overwrite=overwrite, sources=[source]) as root:
        for number, name in enumerate(kept, start=1):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            if link:
                with suppress(OSError):  # hard links do not work across file systems, nor on all of them
                    os.link(source / name, root / name)
            if not (root / name).exists():
                shutil.copyfile(source / name, root / name)
            advance("copying", number, len(kept))
        _keep_source_card(source, root)
        dataset = load_icrl4aht(source)
        (root / CURVES_FIGURE).parent.mkdir()
        plot_layout_curves(dataset, root / CURVES_FIGURE)
        plot_layouts(dataset.layouts, root / LAYOUTS_FIGURE)
        tested = evaluated_on(layout.name for layout in dataset.layouts)
        plot_headroom(read_headroom(HEADROOM_PROTOCOL), tested, root / HEADROOM_FIGURE)
        _add_parquet(dataset, root, advance)
        for folder in sorted((root / TEAMMATES).glob("*/")):
            (folder / RELEASE_CARD).write_text(teammate_card(folder), encoding="utf-8")
        for name in _COPIED_TEXTS:
            shutil.copyfile(card_file(name), root / name)
        write_card(root)
        digests = {name: file_hash(root / name) for name in files_below(root)}
        for name, digest in kept.items():
            if digests.get(name) != digest:
                raise ReleaseError(f"{source / name}: changed while it was copied, sha256 now {digests.get(name)}")
        today = datetime.datetime.now(datetime.UTC).date()
        write_json(root / CROISSANT, croissant(root, digests, published or today))
        write_manifest(root, digests)
    return target


def check_valid(root: Path, advance: NamedProgress = lambda what, done, total: None) -> None:
    """Verify a release.

    Raises:
        ReleaseError: if there is any problem; names the first ones.
    """
    if not (root / MANIFEST).exists():
        read_info(root)  # raises a helpful error if the folder is not a release
    report = verify_release(root, advance=advance)
    if not report.ok:
        found = first_of([f"{finding.file}: {finding.problem}" for finding in report.findings])
        raise ReleaseError(f"{root}: not valid: {found}; see `icrl4aht-data verify`")


def first_of(problems: Sequence[str]) -> str:
    """Return the first three problems as text, and the number of others."""
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return "; ".join(problems[:3]) + more


def teammate_card(folder: Path) -> str:
    """Return the README.md of a learned teammate, made from its policy.json.

    Args:
        folder: `teammates/<sha256>` of a release.

    Raises:
        IndexFormatError: if policy.json is missing or does not describe a teammate; names the file.
    """
    path = folder / _POLICY
    try:
        facts = parse_json(read_text(path))
        if facts["algorithm"] not in ALGORITHMS:
            raise unknown("algorithm", facts["algorithm"], ALGORITHMS)
        return fill_template(
            "teammate.md",
            algorithm=facts["algorithm"],
            layout=get_layout(facts["layout"]).name,
            member=f"{facts['member']:d}",
            checkpoint=f"{facts['checkpoint']:d}",
            step=f"{facts['step']:,d}",
            sha256=folder.name,
            agents=", ".join(f"{slot:d}" for slot in facts["seats"]),
            own_return=f"{facts['return']:.1f}",
            teammate_return=f"{facts['teammate_return']:.1f}",
            seed=f"{facts['seed']:d}",
            widths=", ".join(f"{name} {value}" for name, value in facts["widths"].items()),
            code_version=facts["code_version"],
            return_of=facts["return_of"],
        )
    except (Icrl4ahtError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise IndexFormatError(f"{path}: not the card of a learned teammate: {error!r}") from error


def _is_made_here(name: str) -> bool:
    """Return whether building writes this file, so that the source's version is not copied."""
    folders = ("figures/", f"{PARQUET_INDEX}/", f"{PARQUET_EPISODES}/")
    is_card = name == RELEASE_CARD or name.endswith(f"/{RELEASE_CARD}")
    return is_card or name in (CARD_TABLES, CROISSANT, *_COPIED_TEXTS) or name.startswith(folders)


def _keep_source_card(source: Path, root: Path) -> None:
    """Store the source's card as `SOURCE_CARD`, unless it is generated (starts with YAML) or one is already stored."""
    text = read_text(source / RELEASE_CARD) if (source / RELEASE_CARD).is_file() else ""
    if text and not text.startswith("---\n") and not (root / SOURCE_CARD).exists():
        (root / SOURCE_CARD).write_text(text, encoding="utf-8")


def _add_parquet(dataset: Dataset, root: Path, advance: NamedProgress) -> None:
    """Add the index and, if the release has state records, the episodes as Parquet files."""
    for layout in dataset.layouts:
        histories = dataset.filter(layout=layout.name)
        (root / PARQUET_INDEX / layout.name).mkdir(parents=True)
        for split in {entry.split for entry in histories.entries}:
            to_parquet(histories.filter(split=split), root / PARQUET_INDEX / layout.name / f"{split}.parquet")
    if dataset.has_states:
        write_episodes(dataset, root / PARQUET_EPISODES, advance=partial(advance, "episodes"))
