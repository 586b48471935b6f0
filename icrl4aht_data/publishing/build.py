"""Preparation of a release for publication, with a card, figures, Parquet files and Croissant metadata."""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.dataset import MINI, Dataset, load_icrl4aht
from icrl4aht_data.errors import OptionError, ReleaseError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest, write_manifest
from icrl4aht_data.format.schema import CARD_TABLES, MANIFEST, PARQUET_EPISODES, PARQUET_INDEX, RELEASE_CARD
from icrl4aht_data.plotting import plot_layouts, plot_learning_curves, save_figure
from icrl4aht_data.publishing.croissant import CROISSANT, croissant
from icrl4aht_data.utils.files import file_hash, files_below, write_json
from icrl4aht_data.utils.install_hints import install_command
from icrl4aht_data.utils.text import card_file
from icrl4aht_data.writing.card import CURVES_FIGURE, LAYOUTS_FIGURE, write_card
from icrl4aht_data.writing.parquet import to_parquet, write_episodes
from icrl4aht_data.writing.release_folder import as_path, atomic_folder, check_target

_COPIED_TEXTS = ("LICENSE", "CITATION.cff")
_LIBRARIES = ("matplotlib", "PIL", "pyarrow", "mlcroissant")
"""Modules required for building, which the extras plot and hf install."""


def build_release(
    source: str | Path | None,
    target: str | Path,
    *,
    overwrite: bool = False,
    published: datetime.date | None = None,
    advance: NamedProgress = lambda what, done, total: None,
) -> Path:
    """Copy a release, and add the card, figures and metadata of a published release.

    Args:
        source: a release folder; the bundled mini release by default.
        target: the folder to write; it appears only when it is complete.
        overwrite: replace a release at `target`.
        published: date of publication for Croissant; today by default.
        advance: called with the name of a stage, the number of items done, and their total.

    Raises:
        OptionError: if `target` may not be written, see `release_folder.check_target`, or a library is not installed.
        ReleaseError: if `source` is not valid (the message names the first three problems), or changes while copied.
    """
    source, target = as_path(MINI if source is None else source).resolve(), as_path(target)
    check_target(target, overwrite, [source])
    missing = [name for name in _LIBRARIES if find_spec(name) is None]
    if missing:
        raise OptionError(f"building a release needs {', '.join(missing)}: {install_command('plot', 'hf')}")
    check_valid(source, advance)
    kept = {name: digest for name, digest in read_manifest(source).items() if not _is_written_by_build(name)}
    with atomic_folder(target, overwrite=overwrite, sources=[source]) as root:
        for number, name in enumerate(kept, start=1):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, root / name)
            advance("copying", number, len(kept))
        dataset = load_icrl4aht(source)
        (root / CURVES_FIGURE).parent.mkdir()
        plot_learning_curves(dataset, root / CURVES_FIGURE)
        save_figure(plot_layouts(dataset.layouts), root / LAYOUTS_FIGURE, dpi=120)
        _add_parquet(dataset, root, advance)
        for name in _COPIED_TEXTS:
            shutil.copyfile(card_file(name), root / name)
        write_card(root)
        digests = {name: file_hash(root / name) for name in files_below(root)}
        for name, digest in kept.items():
            if digests.get(name) != digest:
                raise ReleaseError(
                    f"{source / name}: changed while it was copied; sha256 is now {digests.get(name)}; "
                    f"build the release again"
                )
        today = datetime.datetime.now(datetime.UTC).date()
        write_json(root / CROISSANT, croissant(root, digests, published or today))
        write_manifest(root, digests)
    return target


def check_valid(root: Path, advance: NamedProgress = lambda what, done, total: None) -> None:
    """Verify a release, and raise an error if a problem is found.

    Raises:
        ReleaseError: if a problem is found; the message names the first three.
    """
    if not (root / MANIFEST).exists():
        read_info(root)  # raises an error that names the problem if the folder is not a release
    report = verify_release(root, advance=advance)
    if not report.ok:
        found = first_problems([f"{finding.file}: {finding.problem}" for finding in report.findings])
        raise ReleaseError(f"{root}: not valid: {found}; see `icrl4aht-data verify`")


def first_problems(problems: Sequence[str]) -> str:
    """Return text with the first three problems and the number of further problems."""
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return "; ".join(problems[:3]) + more


def _is_written_by_build(name: str) -> bool:
    """Return whether `build_release` writes a file itself, instead of copying the file from the source."""
    folders = ("figures/", f"{PARQUET_INDEX}/", f"{PARQUET_EPISODES}/")
    is_card = name == RELEASE_CARD or name.endswith(f"/{RELEASE_CARD}")
    return is_card or name in (CARD_TABLES, CROISSANT, *_COPIED_TEXTS) or name.startswith(folders)


def _add_parquet(dataset: Dataset, root: Path, advance: NamedProgress) -> None:
    """Add the index and, if the release has state records, the episodes as Parquet files."""
    for layout in dataset.layouts:
        histories = dataset.filter(layout=layout.name)
        (root / PARQUET_INDEX / layout.name).mkdir(parents=True)
        for split in {entry.split for entry in histories.entries}:
            to_parquet(histories.filter(split=split), root / PARQUET_INDEX / layout.name / f"{split}.parquet")
    if dataset.has_states:
        write_episodes(dataset, root / PARQUET_EPISODES, advance=partial(advance, "episodes"))
