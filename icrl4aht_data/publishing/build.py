"""A release made ready for other people: card, pictures, Parquet index and Croissant beside its data."""

from __future__ import annotations

import datetime
import os
import shutil
from contextlib import suppress
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
from icrl4aht_data.format.schema import INFO, MANIFEST, TEAMMATES
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.publishing.croissant import CROISSANT, croissant
from icrl4aht_data.utils.files import parse_json, read_text, write_json
from icrl4aht_data.utils.hashes import file_hash
from icrl4aht_data.utils.templates import card_file, fill_template
from icrl4aht_data.writing.dataset_card import (
    CURVES,
    HEADROOM,
    LAYOUTS,
    PROTOCOL,
    SOURCE_CARD,
    TWIN,
    dataset_card,
    evaluated_on,
)
from icrl4aht_data.writing.parquet import to_parquet
from icrl4aht_data.writing.release import CARD
from icrl4aht_data.writing.release_folder import atomic_folder

_COPIED_TEXTS = ("LICENSE", "CITATION.cff")
_POLICY = "policy.json"


def build_release(
    source: Path | None,
    target: Path,
    *,
    link: bool = False,
    published: datetime.date | None = None,
    advance: NamedProgress = lambda what, done, total: None,
) -> Path:
    """Write a release folder that holds everything of another, and what a published one has beside it.

    Args:
        source: a release folder; the bundled mini release by default.
        target: the folder to make; a release that is there is replaced when the new one is complete.
        link: take the files of `source` by hard links, which costs no space: then whoever changes a file in place
            changes it in both.
        published: the date for Croissant; today by default.
        advance: progress, of verifying and of copying.

    Raises:
        OptionError: if `target` is `source` or no release, or if matplotlib, Pillow or pyarrow is not installed.
        ReleaseError: if `source` is not whole; names the first problems.
    """
    source = (MINI if source is None else source).resolve()
    if target.resolve() == source:
        raise OptionError(f"{target}: the release itself; give another folder")
    missing = [name for name in ("matplotlib", "PIL", "pyarrow") if find_spec(name) is None]
    if missing:
        raise OptionError(f"building a release needs {', '.join(missing)}: pip install 'icrl4aht-data[plot,hf]'")
    check_whole(source, advance)
    kept = {name: digest for name, digest in read_manifest(source).items() if not _is_made_here(name)}
    with atomic_folder(target) as root:
        for number, name in enumerate(kept, start=1):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            _take(source / name, root / name, link)
            advance("copying", number, len(kept))
        _keep_source_card(source, root)
        _add_pictures_and_twin(load_icrl4aht(root), root)
        for folder in sorted((root / TEAMMATES).glob("*/")):
            (folder / CARD).write_text(teammate_card(folder), encoding="utf-8")
        for name in _COPIED_TEXTS:
            shutil.copyfile(card_file(name), root / name)
        (root / CARD).write_text(dataset_card(root), encoding="utf-8")
        new = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()} - kept.keys()
        digests = kept | {name: file_hash(root / name) for name in new}
        today = datetime.datetime.now(datetime.UTC).date()
        write_json(root / CROISSANT, croissant(root, digests, published or today))
        write_manifest(root)
        _check_same(source, root, kept)
    return target


def check_whole(root: Path, advance: NamedProgress = lambda what, done, total: None) -> None:
    """Verify a release.

    Raises:
        ReleaseError: if anything is wrong; names the first problems.
    """
    if not (root / INFO).exists() and not (root / MANIFEST).exists():
        read_info(root)  # says what to give instead
    report = verify_release(root, advance=advance)
    if not report.ok:
        first = "; ".join(f"{finding.file}: {finding.problem}" for finding in report.findings[:3])
        more = f"; and {len(report.findings) - 3} more" if len(report.findings) > 3 else ""
        raise ReleaseError(f"{root}: not whole: {first}{more}; see `icrl4aht-data verify`")


def teammate_card(folder: Path) -> str:
    """README.md of a learned teammate, of what its policy.json says.

    Args:
        folder: `teammates/<sha256>` of a release.

    Raises:
        IndexFormatError: if policy.json is missing or says not what a teammate's does; names the file.
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
            seats=", ".join(f"{seat:d}" for seat in facts["seats"]),
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
    """Whether a file is one that building makes anew."""
    top, _, rest = name.partition("/")
    is_teammates_card = top == TEAMMATES and rest.endswith(f"/{CARD}")
    return name in (CARD, CROISSANT, *_COPIED_TEXTS) or top in ("figures", TWIN) or is_teammates_card


def _take(source: Path, target: Path, link: bool) -> None:
    if link:
        with suppress(OSError):  # another file system, or one without hard links
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def _keep_source_card(source: Path, root: Path) -> None:
    """Keep a card that was not made by filling the template, which begins with YAML, unless one is kept already."""
    text = read_text(source / CARD) if (source / CARD).is_file() else ""
    if text and not text.startswith("---\n") and not (root / SOURCE_CARD).exists():
        (root / SOURCE_CARD).write_text(text, encoding="utf-8")


def _add_pictures_and_twin(dataset: Dataset, root: Path) -> None:
    from icrl4aht_data.plotting import plot_headroom, plot_layout_curves, plot_layouts

    (root / CURVES).parent.mkdir()
    plot_layout_curves(dataset, root / CURVES)
    plot_layouts(dataset.layouts, root / LAYOUTS)
    tested = evaluated_on(layout.name for layout in dataset.layouts)
    plot_headroom(read_headroom(PROTOCOL), tested, root / HEADROOM)
    for layout in dataset.layouts:
        of_layout = dataset.filter(layout=layout.name)
        (root / TWIN / layout.name).mkdir(parents=True)
        for split in {entry.split for entry in of_layout.entries}:
            to_parquet(of_layout.filter(split=split), root / TWIN / layout.name / f"{split}.parquet")


def _check_same(source: Path, root: Path, kept: dict[str, str]) -> None:
    """Whether what was copied is what was verified."""
    found = read_manifest(root)
    changed = [name for name, digest in kept.items() if found.get(name) != digest]
    if changed:
        raise ReleaseError(f"{source / changed[0]}: changed while it was copied, sha256 now {found.get(changed[0])}")
